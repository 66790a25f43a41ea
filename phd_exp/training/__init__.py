"""One run: its configuration checked, its parts built, trained, measured and recorded."""
