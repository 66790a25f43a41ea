"""From run records to tables and pictures. Nothing here imports the model."""
