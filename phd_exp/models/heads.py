"""Heads: from the raw numbers of a network and its camera to a prediction.

A head declares its number of raw numbers and its type of prediction. Loss, metrics and figures use the prediction
alone. With a backbone that locates the object, the raw numbers are relative to its place: `placed` moves them there.
"""

from collections.abc import Callable
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions import Density, PointEstimate, ProjectedHuber
from phd_exp.distributions.gaussian_mixture import GaussianMixture
from phd_exp.distributions.natural import precision
from phd_exp.distributions.shaped import Shaped, StudentT, closest_to_student
from phd_exp.geometry.camera import Camera
from phd_exp.geometry.charts import Chart, DepthScale

Prediction = ProjectedHuber | Shaped | GaussianMixture | PointEstimate


@runtime_checkable
class Head(Protocol):
    """The interface of a head."""

    n_outputs: int
    prediction: type[Density | PointEstimate]

    def __call__(self, raw: Float[Tensor, "*batch n_outputs"], camera: Camera) -> Prediction: ...

    def placed(
        self, raw: Float[Tensor, "*batch n_outputs"], place: Float[Tensor, "*batch 2"]
    ) -> Float[Tensor, "*batch n_outputs"]:
        """Raw numbers of the prediction moved by `place`, a projected position v_p."""
        ...


@runtime_checkable
class SymmetricHead(Head, Protocol):
    """A head that can transform raw numbers of a symmetric view back, as `views=8` needs."""

    def turned_back(
        self, raw: Float[Tensor, "*views n"], signs: Float[Tensor, "*#views 3"]
    ) -> Float[Tensor, "*views n"]:
        """Raw numbers in the frame of an image, given those of its views after `symmetries` of these signs."""
        ...


class DistributionHead:
    """Seven raw numbers -> the Projected Huber distribution, `ProjectedHuber.from_raw`.

    Args:
        depth: constants of the data set.
        free_axis: the distribution has a free axis, by two further raw numbers.

    Examples:
        >>> import torch
        >>> from phd_exp.geometry import Camera, DepthScale
        >>> depth = DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0))
        >>> head = DistributionHead(depth)
        >>> head(torch.zeros(7), Camera(torch.tensor(1500.0), 224.0)).mode
        tensor([0.0000, 0.0000, 3.7500])
    """

    prediction = ProjectedHuber

    def __init__(self, depth: DepthScale, free_axis: bool = False) -> None:
        self.mu_z0 = depth.mu_z0
        self.n_outputs = 9 if free_axis else 7

    def __call__(self, raw: Float[Tensor, "*batch n"], camera: Camera) -> ProjectedHuber:
        # not validated for speed: the training step refuses a loss that is not finite
        return ProjectedHuber.from_raw(raw, f=camera.f, S=camera.S, mu_z0=self.mu_z0, validate_args=False)

    def placed(self, raw: Float[Tensor, "*batch n"], place: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch n"]:
        """Raw numbers with the centre nu_p = B v_p shifted by B `place`: the same shift of v_p for every B."""
        B, _ = precision(raw[..., 2:5])
        return torch.cat([raw[..., :2] + (B @ place[..., None]).squeeze(-1), raw[..., 2:]], dim=-1)

    def turned_back(
        self, raw: Float[Tensor, "*views n"], signs: Float[Tensor, "*#views 3"]
    ) -> Float[Tensor, "*views n"]:
        """Raw numbers in the frame of an image, given those of its views after `symmetries` of these signs.

        A symmetry R changes nu_p to R nu_p, k to R k and B to R B R^T: signs and an exchange of raw numbers, exactly.
        Source: own derivation (`spectral_map` commutes with R); checked in tests/models/test_symmetric_views.py.
        """
        n, b, w, k, other = raw.tensor_split((2, 5, 7, 9), dim=-1)
        x, y, exchange = signs.split(1, dim=-1)
        n, b = n * signs[..., :2], b * torch.cat([x * x, x * y, y * y], dim=-1)
        k = k * signs[..., : k.shape[-1]]
        n, b, k = (torch.where(exchange < 0, part.flip(-1), part) for part in (n, b, k))
        return torch.cat([n, b, w, k, other], dim=-1)


class SurrogateHead:
    """Ten raw numbers -> the Projected Huber density with free axis and rounded mode closest to a Student's t.

    Training maximises the likelihood of the Student's t, which leads to better networks (docs/results/densities.md).
    The tenth number gives its degrees of freedom.

    Args:
        depth: constants of the data set.
        is_rounded: stated by every configuration that this head can build; a head without rounding has left.
    """

    n_outputs = 10
    prediction = ProjectedHuber

    def __init__(self, depth: DepthScale, is_rounded: Literal[True]) -> None:
        self.seven = DistributionHead(depth)
        self.placed, self.turned_back = self.seven.placed, self.seven.turned_back

    def surrogate(self, raw: Float[Tensor, "*batch 10"], camera: Camera) -> Shaped:
        """The Student's t that training fits."""
        return StudentT(self.seven(raw[..., :7], camera), raw[..., 7:])

    def __call__(self, raw: Float[Tensor, "*batch 10"], camera: Camera) -> ProjectedHuber:
        return closest_to_student(self.seven(raw[..., :7], camera), raw[..., 7:])


class ShapedHead:
    """The seven raw numbers of `DistributionHead` and further ones -> a density of another shape.

    Args:
        depth: constants of the data set.
        density: makes the density of the Projected Huber density of the seven numbers, and the further numbers.
        n_further: their number.
    """

    prediction = Shaped

    def __init__(
        self, depth: DepthScale, density: Callable[[ProjectedHuber, Tensor], Shaped], n_further: int = 0
    ) -> None:
        self.seven, self.density = DistributionHead(depth), density
        self.n_outputs = self.seven.n_outputs + n_further
        self.placed = self.seven.placed

    def __call__(self, raw: Float[Tensor, "*batch n_outputs"], camera: Camera) -> Shaped:
        return self.density(self.seven(raw[..., :7], camera), raw[..., 7:])


class MixtureHead:
    """Raw numbers of Gaussians with any covariance, nine each, and of their weights -> `GaussianMixture`.

    Args:
        depth: constants of the data set.
        n_parts: number of Gaussians.
    """

    prediction = GaussianMixture

    def __init__(self, depth: DepthScale, n_parts: int) -> None:
        self.nine, self.n_parts = DistributionHead(depth, free_axis=True), n_parts
        self.n_outputs = 10 * n_parts
        # equal Gaussians would have equal gradients for ever: w_2 sets the Gaussians of zeros at different depths
        self.start = torch.zeros(n_parts, 9)
        self.start[:, 6] = torch.linspace(-0.3, 0.3, n_parts)

    def __call__(self, raw: Float[Tensor, "*batch n"], camera: Camera) -> GaussianMixture:
        numbers, log_weight = self._split(raw)
        around = self.nine(numbers + self.start.to(raw), Camera.unchecked(camera.f[..., None], camera.S))
        return GaussianMixture.about(around, log_weight)

    def placed(self, raw: Float[Tensor, "*batch n"], place: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch n"]:
        """Raw numbers with all Gaussians shifted by `place`."""
        numbers, log_weight = self._split(raw)
        moved = self.nine.placed(numbers, place[..., None, :].expand(*numbers.shape[:-1], 2))
        return torch.cat([moved.flatten(-2), log_weight], dim=-1)

    def _split(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        numbers, log_weight = raw.split((9 * self.n_parts, self.n_parts), dim=-1)
        return numbers.unflatten(-1, (self.n_parts, 9)), log_weight


class ChartHead:
    """Three raw numbers -> the position with these coordinates in a chart.

    Examples:
        >>> import torch
        >>> from phd_exp.geometry import Camera, DepthScale, LogDepth
        >>> head = ChartHead(DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0)), LogDepth)
        >>> head(torch.zeros(3), Camera(torch.tensor(1500.0), 224.0)).mode
        tensor([0.0000, 0.0000, 3.7500])
    """

    n_outputs = 3
    prediction = PointEstimate

    def __init__(self, depth: DepthScale, chart: Callable[[DepthScale], Chart]) -> None:
        self.chart = chart(depth)

    def __call__(self, raw: Float[Tensor, "*batch 3"], camera: Camera) -> PointEstimate:
        return PointEstimate(raw, self.chart, camera)

    def placed(self, raw: Float[Tensor, "*batch 3"], place: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
        """Raw numbers shifted by `place` if the chart's first coordinates are v_p, else unchanged."""
        if not self.chart.has_projection:
            return raw
        return torch.cat([raw[..., :2] + place, raw[..., 2:]], dim=-1)
