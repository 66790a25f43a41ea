"""Predictions over positions in front of a camera: the Projected Huber and other densities, and point estimates."""

from phd_exp.distributions.density import Density
from phd_exp.distributions.mixture import Mixture
from phd_exp.distributions.point_estimate import PointEstimate
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.temperature import Temperature

__all__ = ["Density", "Mixture", "PointEstimate", "ProjectedHuber", "Temperature"]
