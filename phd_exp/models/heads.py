"""Heads: from the raw numbers of a network and the camera it is told to a prediction.

A head says how many raw numbers it wants and what kind of prediction it makes. The loss, the metrics and the
figures see the prediction alone. Where a backbone says in which place it sees the object, the raw numbers are made
relative to that: `placed` gives those of the same prediction moved there.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions import PointEstimate, ProjectedHuber
from phd_exp.distributions.spd import spectral_map
from phd_exp.geometry.camera import Camera
from phd_exp.geometry.charts import Chart, DepthScale

Prediction = ProjectedHuber | PointEstimate


@runtime_checkable
class Head(Protocol):
    """What a regressor asks of a head."""

    n_outputs: int
    prediction: type[Prediction]

    def __call__(self, raw: Float[Tensor, "*batch n_outputs"], camera: Camera) -> Prediction: ...

    def placed(
        self, raw: Float[Tensor, "*batch n_outputs"], place: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch n_outputs"]:
        """The raw numbers of the same prediction, moved by `place`, a projected position v_p."""
        ...


class DistributionHead:
    """Seven raw numbers -> the Projected Huber distribution."""

    n_outputs = 7
    prediction = ProjectedHuber

    def __init__(self, depth: DepthScale) -> None:
        self.mu_z0 = depth.mu_z0

    def __call__(self, raw: Float[Tensor, "*batch 7"], camera: Camera) -> ProjectedHuber:
        # the loss calls this for every batch; a NaN is caught once, by the training step
        return ProjectedHuber.from_raw(raw, f=camera.f, S=camera.S, mu_z0=self.mu_z0, validate_args=False)

    def placed(
        self, raw: Float[Tensor, "*batch 7"], place: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch 7"]:
        """Those of the density whose middle nu_p = B v_p lies B `place` further: as far at any precision."""
        B, _ = spectral_map(raw[..., 2:5])
        return torch.cat([raw[..., :2] + (B @ place[..., None]).squeeze(-1), raw[..., 2:]], dim=-1)


class ChartHead:
    """Three raw numbers -> the position with these coordinates in a chart."""

    n_outputs = 3
    prediction = PointEstimate

    def __init__(self, depth: DepthScale, chart: Callable[[DepthScale], Chart]) -> None:
        self.chart = chart(depth)

    def __call__(self, raw: Float[Tensor, "*batch 3"], camera: Camera) -> PointEstimate:
        return PointEstimate(raw, self.chart, camera)

    def placed(
        self, raw: Float[Tensor, "*batch 3"], place: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch 3"]:
        """Further by `place` where the chart's first coordinates are v_p; elsewhere the features must tell."""
        if not self.chart.has_projection:
            return raw
        return torch.cat([raw[..., :2] + place, raw[..., 2:]], dim=-1)
