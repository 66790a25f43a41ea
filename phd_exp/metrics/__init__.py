"""How good an estimate is and how far its uncertainty can be trusted. Nothing here knows a model."""
