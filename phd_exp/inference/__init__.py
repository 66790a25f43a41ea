"""A trained run at work: images in, positions with their uncertainty out; and its export, which needs no torch."""
