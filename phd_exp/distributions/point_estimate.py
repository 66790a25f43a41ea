"""The prediction of a regression baseline: a point in a chart."""

from dataclasses import dataclass
from typing import ClassVar, Literal

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
