"""What fusion returns."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from phd_exp.fusion import solver
from phd_exp.fusion.linear import product
from phd_exp.fusion.problems import Problems
from phd_exp.fusion.status import FusionError, Status


@dataclass(frozen=True)
class Fused:
    """One position for each problem, and how sure it is; NaN where a problem failed.

    Args:
        point: the most likely position, world, metres.
        certificate: how far the true optimum can be from `point`, metres; inf where the energy is too flat to tell.
        subgradient: norm of a subgradient of the summed -log p at `point`, nats per metre; 0 proves the optimum.
        surprise: credible level of `point` in each view, near 1 where a camera does not believe it; NaN where it is
            masked out.
        status: `Status` of each problem.
        solved: the problems that were solved, from which mean and covariance are computed when they are asked for.
        optimum: their unknowns.
    """

    point: Float[Tensor, "*problems 3"]
    certificate: Float[Tensor, "*problems"]
    subgradient: Float[Tensor, "*problems"]
    surprise: Float[Tensor, "*problems cameras"]
    status: Int[Tensor, "*problems"]
    solved: Problems
    optimum: Float[Tensor, "k solved"]

    @property
    def mean(self) -> Float[Tensor, "*problems 3"]:
        """The expected position under the product of the densities, world, metres."""
        return self._moments[0]

    @property
    def covariance(self) -> Float[Tensor, "*problems 3 3"]:
        """Covariance of the position about its mean, square metres; of rank 2 on a plane."""
        return self._moments[1]

    @cached_property
    @torch.no_grad()
    def _moments(self) -> tuple[Tensor, Tensor]:
        mean = torch.full_like(self.point, torch.nan)
        covariance = mean[..., None].repeat(*[1] * mean.ndim, 3)
        found = self.status == Status.FUSED
        if bool(found.any()):
            u_mean, u_covariance = solver.moments(solver.views(self.solved), self.optimum)
            D = self.solved.directions
            mean[found] = self.solved.in_world(u_mean)
            covariance[found] = product(product(D, u_covariance.permute(2, 0, 1)), D.mT)
        return mean, covariance

    def errors(self) -> list[str]:
        """One line for each problem that failed: which, and why."""
        failed = (self.status != Status.FUSED).nonzero().tolist()
        reasons = [Status(code).reason for code in self.status[self.status != Status.FUSED].tolist()]
        return [
            f"problem {', '.join(map(str, index)) or 0}: {reason}"
            for index, reason in zip(failed, reasons, strict=True)
        ]

    def raise_if_failed(self) -> None:
        """Raises FusionError with the `errors`, if there are any."""
        if lines := self.errors():
            raise FusionError("\n".join(lines))
