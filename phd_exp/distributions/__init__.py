"""Predictions over positions in front of a camera: the Projected Huber distribution, and the bare point estimate."""

from phd_exp.distributions.mixture import Mixture
from phd_exp.distributions.point_estimate import PointEstimate
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.temperature import Temperature

__all__ = ["Mixture", "PointEstimate", "ProjectedHuber", "Temperature"]
