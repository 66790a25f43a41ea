"""What fusion returns."""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from phd_exp.fusion.status import FusionError, Status


@dataclass(frozen=True)
class Fused:
    """One position for each problem, and how sure it is; NaN where a problem failed.

    Args:
        point: the most likely position, world, metres.
        mean: its expectation, the estimate of least expected squared error, world, metres.
        covariance: of the position about its mean, square metres; of rank 2 on a plane.
        certificate: how far the true optimum can be from `point`, metres; inf where the energy is too flat to tell.
        subgradient: norm of a subgradient of the summed -log p at `point`, nats per metre; 0 proves the optimum.
        surprise: credible level of `point` in each view, near 1 where a camera does not believe it; NaN where it is
            masked out.
        status: `Status` of each problem.
    """

    point: Float[Tensor, "*problems 3"]
    mean: Float[Tensor, "*problems 3"]
    covariance: Float[Tensor, "*problems 3 3"]
    certificate: Float[Tensor, "*problems"]
    subgradient: Float[Tensor, "*problems"]
    surprise: Float[Tensor, "*problems cameras"]
    status: Int[Tensor, "*problems"]

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

    def reshaped(self, problems: torch.Size) -> "Fused":
        """The same results with another batch shape."""
        return Fused(*(value.reshape(problems + value.shape[1:]) for value in self._tensors))

    @property
    def _tensors(self) -> list[Tensor]:
        return [getattr(self, field.name) for field in fields(self)]


def unfused(status: Int[Tensor, " problems"], cameras: int) -> Fused:
    """Results without any numbers yet."""

    def missing(*shape: int) -> Tensor:
        return torch.full((len(status), *shape), torch.nan, dtype=torch.float64, device=status.device)

    return Fused(missing(3), missing(3), missing(3, 3), missing(), missing(), missing(cameras), status)
