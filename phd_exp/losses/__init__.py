"""Losses: a prediction and the true positions -> one number per sample; training minimises the mean."""

from phd_exp.losses.mae import MeanAbsoluteError
from phd_exp.losses.nll import NegativeLogLikelihood

__all__ = ["MeanAbsoluteError", "NegativeLogLikelihood"]
