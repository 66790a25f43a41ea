"""What training minimises, each a function of a prediction and the true position."""

from phd_exp.losses.mae import MeanAbsoluteError
from phd_exp.losses.nll import NegativeLogLikelihood

__all__ = ["MeanAbsoluteError", "NegativeLogLikelihood"]
