"""The prediction of a regression baseline: a point in a chart, and the density that its loss implies."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.geometry.camera import Camera
from phd_exp.geometry.charts import Chart


@dataclass(frozen=True)
class PointEstimate:
    """A position given by its coordinates in a chart, as seen by a camera."""

    has_covariance: ClassVar[bool] = False
    has_closed_forms: ClassVar[Literal[False]] = False
    coordinates: Float[Tensor, "*batch 3"]
    chart: Chart
    camera: Camera

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """The position in the camera frame, in metres. Named as the point estimate of a distribution is."""
        return self.chart.position(self.coordinates, self.camera)

    def residual(self, xyz: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Estimate minus truth, in the coordinates of the chart."""
        return self.coordinates - self.chart.coordinates(xyz, self.camera)


@dataclass(frozen=True)
class PointDensity:
    """The density whose -log is the residual's norm over a constant scale, in the coordinates of the chart.

    p(v) = exp(-|c(v) - c_0|/s) |det dc/dv| / (8 pi s^3): minimising the mean norm of residuals is maximum likelihood
    under it. Coordinates that belong to z < 0 have their share of it.

    Args:
        estimate: its coordinates c_0, chart and camera.
        scale: s, in units of the chart's coordinates.

    Source: own derivation (int exp(-|r|/s) d^3 r = 8 pi s^3).
    """

    estimate: PointEstimate
    scale: float

    def log_prob(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """Log density of a position (metres), nats per cubic metre; -inf where the chart has no coordinates."""
        chart, camera = self.estimate.chart, self.estimate.camera
        distance = self.estimate.residual(xyz).norm(dim=-1)
        # v -> -v keeps v_p and turns z_p round, so that the determinant is that of the position in front
        in_front = torch.cat([xyz[..., :2], xyz[..., 2:].abs()], dim=-1)
        volume = chart.log_abs_det_jacobian(in_front, camera)
        value = volume - distance / self.scale - math.log(8 * math.pi * self.scale**3)
        return value.masked_fill(~distance.isfinite(), -torch.inf)

    def rsample(self, shape: tuple[int, ...], generator: torch.Generator) -> Float[Tensor, "*shape 3"]:
        """Exact samples: a random direction, and a distance of density r^2 exp(-r/s): a sum of three exponentials."""
        c_0 = self.estimate.coordinates
        uniform = torch.rand((*shape, *c_0.shape), generator=generator, dtype=c_0.dtype)
        distance = -self.scale * torch.log1p(-uniform).sum(-1, keepdim=True)
        normal = torch.randn((*shape, *c_0.shape), generator=generator, dtype=c_0.dtype)
        residual = distance * normal / normal.norm(dim=-1, keepdim=True)
        return self.estimate.chart.position(c_0 + residual, self.estimate.camera)
