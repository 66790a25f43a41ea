"""Probabilistic 3-D position estimation from a single camera with the Projected Huber distribution."""

__version__ = "0.1.0"
