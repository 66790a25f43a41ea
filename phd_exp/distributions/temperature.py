"""Recalibration: temperatures that change the uncertainty of every prediction but not its mode.

A network's small spreads may be too large and its large ones too small, or the other way round. So the log of a
temperature is a parabola in the log of the predicted precision.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions.huber import huber_energy
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.rounded import depth_law

_WIDEST = 80.0  # of log(1/temperature); a fit beyond has no minimum
_ENDS = (0.05, 0.95)  # quantiles of the fitted predictions between which temperatures vary
_PRIORS = (0.5, 0.3)  # standard deviations of normal priors of slope and bend about 0, for few or equal predictions
_NARROWEST = 1e-9  # replaces half the range of log precisions where it is 0, because all are equal

Values = Float[np.ndarray, " samples"]


@dataclass(frozen=True)
class Slope:
    """The change of log T with the log precision u: `slope` x + `bend` (y^2 - 1/3), constant outside `low` to `high`.

    x = u - (low + high)/2 is the distance from the middle, and y runs from -1 at `low` to 1 at `high`.
    """

    slope: float
    low: float
    high: float
    bend: float = 0.0

    def change(self, log_precision: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """log T less that of a typical prediction."""
        x = log_precision.clamp(self.low, self.high) - (self.low + self.high) / 2
        y = x / max((self.high - self.low) / 2, _NARROWEST)
        return self.slope * x + self.bend * (y.square() - 1 / 3)


@dataclass(frozen=True)
class Temperature:
    """A' = A / projected and a' = a / depth: above 1 for overconfident predictions, below 1 for underconfident ones.

    Args:
        projected: the temperature of the projection; with a slope, that of a typical prediction.
        depth: the temperature of depth, likewise.
        projected_slope: change of the log of `projected` with log|A|/2; None: all predictions share one.
        depth_slope: change of the log of `depth` with log a, likewise.

    Examples:
        >>> p = ProjectedHuber(torch.zeros(2), torch.tensor(4.0), 100 * torch.eye(2), torch.tensor(20.0))
        >>> wider = Temperature(projected=1.0, depth=2.0).apply(p)
        >>> bool(wider.a == p.a / 2), torch.equal(wider.mode, p.mode)
        (True, True)
    """

    projected: float
    depth: float
    projected_slope: Slope | None = None
    depth_slope: Slope | None = None

    def __str__(self) -> str:
        return f"A / {self.projected:.4g}, a / {self.depth:.4g}"

    @classmethod
    def fit(cls, distribution: ProjectedHuber, xyz: Float[Tensor, "samples 3"]) -> "Temperature":
        """The temperatures that minimise the mean NLL of true positions (metres) under a batch of predictions.

        With log T = -v this NLL is the sum of the means of h(e^v |q|) - 2 v and of the NLL of depth at the precision
        a e^v. The best v that all predictions share is the root of the derivative. It starts the search for v, slope
        and bend; the last two have normal priors about 0.

        Raises ValueError if there are no samples, if one is not finite or not in front of the camera, or if all lie
        at their modes, so that no temperature is low enough.
        Source: temperature scaling (Guo et al., 2017); the slopes are an own extension. Checked in
        tests/distributions/test_temperature.py.
        """
        xyz = xyz.detach().double()
        q = distribution.whiten(xyz).detach().double()
        log_t = (xyz[..., 2].log() - distribution.mu_z.log()).detach().double()
        log_A, log_a = (u.detach().double().expand_as(log_t) for u in _log_precisions(distribution))
        for values in (xyz, q, log_t, log_A, log_a):
            if values.numel() == 0 or not bool(values.isfinite().all()):
                raise ValueError(
                    "temperatures are fitted to finite predictions and positions with z > 0, at least one, but "
                    f"{int((~values.isfinite()).sum())} of {values.numel()} numbers are not finite"
                )
        projected, projected_slope = _fit(partial(_projected_nll, q), log_A)
        depth, depth_slope = _fit(partial(_depth_nll, log_t, log_a, distribution.rounding), log_a)
        return cls(projected, depth, projected_slope, depth_slope)

    def apply(self, distribution: ProjectedHuber) -> ProjectedHuber:
        """The same predictions at these temperatures; mu_xy and mu_z stay."""
        if self.projected_slope is None or self.depth_slope is None:
            return distribution.tempered(self.projected, self.depth)
        log_A, log_a = _log_precisions(distribution)
        projected = self.projected * self.projected_slope.change(log_A).exp()
        return distribution.tempered(projected, self.depth * self.depth_slope.change(log_a).exp())


def _log_precisions(distribution: ProjectedHuber) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    return distribution.log_det_A / 2, distribution.a.log()


def _projected_nll(q: Tensor, v: Tensor) -> Tensor:
    """h(e^v |q|) - 2 v; convex in v."""
    return huber_energy(v.exp()[:, None] * q) - 2 * v


def _depth_nll(log_t: Tensor, log_a: Tensor, rounding: float, v: Tensor) -> Tensor:
    """-log p(t) at the precision a e^v."""
    law = depth_law(log_a + v, rounding)
    return law.energy(log_t) + law.log_normaliser


def _fit(nll: Callable[[Tensor], Tensor], log_precision: Tensor) -> tuple[float, Slope]:
    """The typical temperature and its change with the least mean of nll(v)."""
    low, high = log_precision.quantile(torch.tensor(_ENDS).double()).tolist()
    slope, bend = Slope(1.0, low, high), Slope(0.0, low, high, 1.0)
    changes = [torch.ones_like(log_precision), *(-one.change(log_precision) for one in (slope, bend))]
    by = torch.stack(changes)  # of v = -log T
    weight = np.array([0.0, *(1 / (prior**2 * len(log_precision)) for prior in _PRIORS)])

    def loss(parameters: Values) -> tuple[float, Values]:
        leaf, penalty = torch.tensor(parameters, requires_grad=True), weight * parameters
        with torch.enable_grad():
            value = nll(leaf @ by).mean()
            (slope,) = torch.autograd.grad(value, leaf)
        return value.item() + penalty @ parameters / 2, slope.numpy() + penalty

    from scipy.optimize import minimize  # imported slowly, and only fits need it

    start = _root(lambda v: loss(np.array([v, 0.0, 0.0]))[1][0])
    found = minimize(loss, (start, 0.0, 0.0), jac=True, method="BFGS", tol=1e-9).x.tolist()
    return math.exp(-found[0]), Slope(found[1], low, high, found[2])


def _root(derivative: Callable[[float], float]) -> float:
    """The v at which a derivative, negative for small v and positive for large v, is zero."""
    from scipy.optimize import brentq

    width = 1.0
    while not derivative(-width) < 0 < derivative(width):
        width *= 2
        if width > _WIDEST:
            raise ValueError("no temperature fits: the errors are zero, or out of proportion to the predictions")
    return float(brentq(derivative, -width, width, xtol=1e-12))
