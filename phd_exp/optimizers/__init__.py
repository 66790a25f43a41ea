"""Optimizers beyond those of torch."""
