"""Recalibration: two temperatures that change the uncertainty of every prediction but not its mode."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.optimize import brentq
from torch import Tensor

from phd_exp.distributions.depth import depth_mean_energy
from phd_exp.distributions.projected_huber import ProjectedHuber

_WIDEST = 80.0  # of log(1/temperature); a fit beyond has no minimum


@dataclass(frozen=True)
class Temperature:
    """A' = A / projected and a' = a / depth: above 1 for overconfident predictions, below 1 for underconfident ones.

    Examples:
        >>> p = ProjectedHuber(torch.zeros(2), torch.tensor(4.0), 100 * torch.eye(2), torch.tensor(20.0))
        >>> wider = Temperature(projected=1.0, depth=2.0).apply(p)
        >>> bool(wider.a == p.a / 2), torch.equal(wider.mode, p.mode)
        (True, True)
    """

    projected: float
    depth: float

    @classmethod
    def fit(cls, distribution: ProjectedHuber, xyz: Float[Tensor, "samples 3"]) -> "Temperature":
        """The temperatures that minimise the mean NLL of true positions (metres) under a batch of predictions.

        The mean NLL is a sum of one function of each temperature, convex in its reciprocal r:
        h(r |q|) - 2 log r and a r max(t, 1/t) + log N(a r). Each minimum is the one root of a derivative.

        Raises ValueError if there are no samples, if one is not finite or not in front of the camera, or if all lie
        at their modes, so that no temperature is low enough.
        Source: temperature scaling (Guo et al., 2017); convexity: h is convex and grows, and log N(a) is the log of
        an integral of exponentials of a. Checked in tests/distributions/test_temperature.py.
        """
        xyz = xyz.detach().double()
        radius = distribution.whiten(xyz).norm(dim=-1).detach().double()
        energy = distribution.depth_energy(xyz[..., 2]).detach().double()
        log_a = distribution.a.detach().double().log().expand_as(energy)
        for values in (xyz, radius, energy, log_a):
            if values.numel() == 0 or not bool(values.isfinite().all()):
                raise ValueError(
                    "temperatures are fitted to finite predictions and positions with z > 0, at least one, but "
                    f"{int((~values.isfinite()).sum())} of {values.numel()} numbers are not finite"
                )
        # the slopes are r d/dr of the mean of h(r |q|) - 2 log r
        projected = _temperature(lambda r: torch.minimum(r * radius, (r * radius).square()).mean() - 2)
        # and of r a max(t, 1/t) + log N(r a): actual minus predicted energies
        depth = _temperature(lambda r: (r * energy - depth_mean_energy(log_a + r.log())).mean())
        return cls(projected, depth)

    def apply(self, distribution: ProjectedHuber) -> ProjectedHuber:
        """The same predictions at these temperatures; mu_xy and mu_z stay."""
        return distribution.tempered(self.projected, self.depth)


def _temperature(slope: Callable[[Tensor], Tensor]) -> float:
    """The 1/r at which the slope, negative for small r and positive for large r, is zero."""

    def at(log_r: float) -> float:
        return float(slope(torch.tensor(log_r, dtype=torch.float64).exp()))

    width = 1.0
    while not at(-width) < 0 < at(width):
        width *= 2
        if width > _WIDEST:
            raise ValueError("no temperature fits: the errors are zero, or out of proportion to the predictions")
    return math.exp(-brentq(at, -width, width, xtol=1e-12))
