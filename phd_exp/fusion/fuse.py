"""One position from the predictions of several cameras, optionally on a plane."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import stats
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.rounded import depth_law
from phd_exp.fusion.pose import Plane, Pose
from phd_exp.fusion.problems import Problems
from phd_exp.fusion.views import Status
from phd_exp.hardware import one_thread

# `kernels` and `moments` are imported in the functions that use them: importing numba takes a second


@dataclass(frozen=True)
class Fused:
    """One position for each problem and its uncertainty; NaN where a problem failed.

    Args:
        point: the most likely position, world, metres.
        subgradient: norm of a subgradient of the summed -log p at `point`, nats per metre; 0 proves the optimum.
        status: `Status` of each problem: FUSED if the subgradient is at most 1e-6 of the pull of all depths.
        problems: the problems, `unknowns` their solution, and `excess` the energy of each view above its minimum;
            surprise, mean and covariance are computed from them on demand.
        shared: of `fuse_shared`: the estimated scale, mean and covariance.
    """

    point: Float[Tensor, "*problems 3"]
    subgradient: Float[Tensor, "*problems"]
    status: Int[Tensor, "*problems"]
    problems: Problems
    unknowns: Float[Tensor, "flat 3"]
    excess: Float[Tensor, "flat cameras"]
    shared: tuple[Tensor, Tensor, Tensor] | None = None

    @cached_property
    def surprise(self) -> Float[Tensor, "*problems cameras"]:
        """Credible level of `point` in each view, near 1 where it contradicts the view; NaN where masked out."""
        with one_thread():
            level = depth_law(self.problems.a.log(), self.problems.predictions.rounding).level(self.excess)
        return _entered(level.masked_fill(~self.problems.mask, torch.nan), self.status)

    @property
    def mean(self) -> Float[Tensor, "*problems 3"]:
        """The expected position under the product of the densities, world, metres."""
        return self._moments[0]

    @property
    def covariance(self) -> Float[Tensor, "*problems 3 3"]:
        """Covariance of the position about its mean, square metres; of rank 2 on a plane.

        Exact for one camera without a plane. For several cameras, and on a plane, a quadrature: see `moments`.
        """
        return self._moments[1]

    @cached_property
    @torch.no_grad()
    def _moments(self) -> tuple[Tensor, Tensor]:
        if self.shared is not None:
            return self.shared[1:]
        problems, fused = self.problems, self.status.cpu().flatten() == Status.FUSED
        alone, alone_mean, alone_covariance = problems.alone()
        u, C, _ = self._quadrature(fused & ~alone, np.empty(0))
        mean = problems.in_world(u)
        covariance = problems.directions @ C @ problems.directions.mT
        mean[alone], covariance[alone] = alone_mean, alone_covariance
        return _entered(mean, self.status), _entered(covariance, self.status)

    @torch.no_grad()
    def coverage(self, levels: Sequence[float]) -> Float[Tensor, "*problems levels"]:
        """The probability of the ellipsoids of mean and covariance that have these probabilities under a Gaussian.

        The densities have heavier tails than a Gaussian: 0.878 of the positions lie in the 90 % ellipsoid of one
        camera, 0.888 in that of four. For calibrated predictions this is the expected share of true positions. The
        quadrature of `moments` is accurate to 0.01 for one problem and to 0.001 on average.
        """
        radii = stats.chi2.ppf(np.array(levels), self.problems.dimensions)
        fused = self.status.cpu().flatten() == Status.FUSED
        return _entered(self._quadrature(fused, radii)[2], self.status)

    def _quadrature(
        self, chosen: Bool[Tensor, " flat"], radii: Float[np.ndarray, " levels"]
    ) -> tuple[Float[Tensor, "flat 3"], Float[Tensor, "flat 3 3"], Float[Tensor, "flat levels"]]:
        """The results of `moments` for the chosen problems, NaN for the others."""
        from phd_exp.fusion.kernels import all_moments
        from phd_exp.fusion.moments import student_points

        mean, covariance, inside = (np.full((len(chosen), *s), np.nan) for s in ((3,), (3, 3), radii.shape))
        views = (*self.problems.views, self.unknowns.numpy(), *student_points(self.problems.dimensions))
        all_moments(chosen.numpy(), *views, radii, mean, covariance, inside)
        return torch.from_numpy(mean), torch.from_numpy(covariance), torch.from_numpy(inside)

    def errors(self) -> list[str]:
        """One line for each problem that failed: its index and the reason."""
        failed = (self.status != Status.FUSED).nonzero().tolist()
        return [
            f"problem {', '.join(map(str, index)) or 0}: {Status(int(self.status[tuple(index)])).reason}"
            for index in failed
        ]


@torch.no_grad()
def fuse(
    predictions: ProjectedHuber,
    pose: Pose,
    plane: Plane | None = None,
    mask: Bool[Tensor, "*problems cameras"] | None = None,
    contradiction: float = 1e-9,
) -> Fused:
    """The position v of highest sum_i log p_i(R_i v + t_i), optionally among the points of a plane.

    The problem is convex, and not smooth where z = mu_z. It is solved on the CPU in float64, one problem per core at
    a time; results are on the device of the predictions. A problem that fails has its reason in `status` and does
    not affect the others.

    Args:
        predictions: of batch shape (*problems, cameras).
        pose: of each camera; its batch shape broadcasts to that.
        plane: one for each problem, or one for all.
        mask: which cameras take part (default: all); the predictions and poses of the others are ignored.
        contradiction: a view rules out a position if it gives less than this probability to all positions that are
            no more likely. A problem fails if at least half of its views rule out its optimum; with 0, none does.

    Raises:
        ValueError: shapes do not broadcast.

    Examples:
        >>> A, a = 300 * torch.eye(2).expand(2, 2, 2), torch.full((2,), 10.0)
        >>> predictions = ProjectedHuber(torch.zeros(2, 2), torch.tensor([4.0, 6.0]), A, a)
        >>> ahead = Pose(torch.eye(3), torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))  # the second 2 m behind
        >>> fuse(predictions, ahead).point
        tensor([0., 0., 4.], dtype=torch.float64)

    Source: paper, section "Multi-view fusion and ground plane constraints".
    """
    from phd_exp.fusion.kernels import solve

    with one_thread():
        problems = Problems.posed(predictions, pose, plane, mask)
        n, cameras = problems.mask.shape
        u, gradient, excess = (torch.zeros(n, size, dtype=torch.float64) for size in (3, 2, cameras))
        filled = (values.numpy() for values in (problems.status, u, gradient, excess))
        solve(*problems.views, problems.free_slope.numpy(), *filled)
        ruled_out = _improbable(excess, problems, contradiction).sum(-1)
        contradicted = (problems.status == Status.FUSED) & (2 * ruled_out >= problems.mask.sum(-1))
        problems.status[contradicted] = Status.CONTRADICTION
        status = problems.status.reshape(predictions.batch_shape[:-1]).to(predictions.a.device)
        point, subgradient = (_entered(values, status) for values in (problems.in_world(u), gradient[:, 0]))
        return Fused(point, subgradient, status, problems, u, excess)


def _improbable(
    excess: Float[Tensor, "flat cameras"], problems: Problems, probability: float
) -> Bool[Tensor, "flat cameras"]:
    """Whether all positions of at least this excess energy have less than this probability in the view."""
    if probability == 0:
        return torch.zeros_like(problems.mask)
    # they have at least e^(-excess)/2, which rules out most views without the exact level
    rest = (excess > -math.log(2 * probability)) & problems.mask
    level = depth_law(problems.a[rest].log(), problems.predictions.rounding).level(excess[rest])
    return rest.masked_scatter(rest, level > 1 - probability)


def _entered(values: Float[Tensor, "flat ..."], status: Int[Tensor, "*problems"]) -> Tensor:
    """In the shape and on the device of the status, NaN where a problem failed."""
    event = values.shape[1:]
    failed = (status != Status.FUSED).reshape((*status.shape, *[1] * len(event)))
    return values.reshape(status.shape + event).to(status.device).masked_fill(failed, torch.nan)
