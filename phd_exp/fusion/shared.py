"""Fusion of views whose depths share one unknown factor, such as the object's size over the expected one.

Given the position v and the factor e^s, view i predicts v e^(-s): its energy is E_i(R_i v + t_i, e^s mu_z). With a
normal s and a uniform v, the joint density is proportional to exp(-sum_i E_i - 3 s - s^2/(2 deviation^2)).
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.depth import depth_mean_and_variance
from phd_exp.fusion.fuse import Fused, Mixture, fuse
from phd_exp.fusion.pose import Plane, Pose

LEAST_OWN = 0.01  # the smallest part of a view's variance of depth that is its own
ZOOMS = 3  # each by up to a factor of 4, from the law of s before the views are known to the law after
_NODES, _WEIGHTS = map(torch.from_numpy, np.polynomial.hermite_e.hermegauss(9))
_LOG_A = np.linspace(-14, 21, 5001)


def own_part(
    predictions: ProjectedHuber, deviation: Float[Tensor, "*#batch"]
) -> tuple[ProjectedHuber, Float[Tensor, "*batch"]]:
    """The density of each view given that s = 0, and the deviation of s that restores its mean and covariance.

    For z = e^s z', 1 + Var[z]/E[z]^2 is the product of those of e^s, which is e^(deviation^2), and of z'. In a view
    that is too certain for that, the deviation is smaller: a hundredth of the variance remains its own.
    """
    mu_xy, mu_z, A, a = (getattr(predictions, name).double().cpu() for name in ("mu_xy", "mu_z", "A", "a"))
    mean, ratio = _mean_and_ratio(a.log())
    growth = torch.minimum(deviation.square().exp(), (1 + ratio) / (1 + LEAST_OWN * ratio))
    ratios = _mean_and_ratio(torch.from_numpy(_LOG_A))[1].log().numpy()
    own_ratio = ((1 + ratio) / growth - 1).log().numpy()
    log_a = torch.from_numpy(np.interp(-own_ratio, -ratios, _LOG_A))
    change = mean / _mean_and_ratio(log_a)[0] / growth.sqrt()  # of mu_z
    A = A * (change * growth)[..., None, None]
    return ProjectedHuber(mu_xy, mu_z * change, A, log_a.exp(), validate_args=False), growth.log().sqrt()


def _mean_and_ratio(log_a: Tensor) -> tuple[Tensor, Tensor]:
    """E[t], and Var[t]/E[t]^2, which falls with a."""
    mean, variance = depth_mean_and_variance(log_a)
    return mean, variance / mean.square()


@torch.no_grad()
def fuse_shared(
    predictions: ProjectedHuber,
    pose: Pose,
    deviation: Float[Tensor, "*#problems"] | float,
    plane: Plane | None = None,
    mask: Bool[Tensor, "*problems cameras"] | None = None,
    contradiction: float = 1e-9,
) -> Fused:
    """`fuse` where the errors of the views' depths have a common part: a factor e^s with s ~ N(0, deviation^2).

    Each view's density is split into that part and its own (`own_part`). Given s the problem is that of `fuse`. The
    law of s given all views is found at 9 nodes, by Gauss's rule about its mean; the density at each is the highest
    one times the volume of the covariance. `mean` and `covariance` are those of the mixture, `mixture.scale` is
    e^(E[s]); `point`, `certificate`, `surprise` and `coverage` are given that scale. One camera alone has s = 0.

    In r = e^(-s) and u = r v, what a camera measures, R_i u + r t_i, is affine. So the energy is convex in (u, r),
    and its minimum over u, plus s^2/(2 deviation^2), is convex in r for s > -1: the search for the nodes has one
    goal. (A view with a smaller deviation breaks this, but then its s matters less.)
    Results are on the CPU.

    Examples:
        >>> A, a = 300 * torch.eye(2).expand(2, 2, 2), torch.full((2,), 10.0)
        >>> predictions = ProjectedHuber(torch.zeros(2, 2), torch.tensor([4.4, 6.6]), A, a)  # both 10 % too far
        >>> ahead = Pose(torch.eye(3), torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]))  # the second 2 m behind
        >>> fused = fuse_shared(predictions, ahead, deviation=0.12)
        >>> bool(fused.covariance[2, 2] > fuse(predictions, ahead).covariance[2, 2])
        True

    Source: own derivation; checked against a grid and simulated scenes in tests/fusion/test_shared.py.
    """
    mask = torch.ones(predictions.batch_shape, dtype=torch.bool) if mask is None else mask.cpu()
    cameras = mask.sum(-1)
    known = torch.where(cameras > 1, torch.as_tensor(deviation, dtype=torch.float64), 0)
    own, deviations = own_part(predictions, known[..., None])
    deviations = deviations.masked_fill(~mask, 0)
    average = deviations.sum(-1) / cameras.clamp_min(1)
    centre, width = torch.zeros_like(average), torch.ones_like(average)
    nodes, weights = (values.reshape(-1, *[1] * average.ndim) for values in (_NODES, _WEIGHTS))
    for zoom in range(ZOOMS + 1):
        at = centre + width * nodes  # s in deviations
        each = fuse(_grown(own, deviations, at), pose, plane, mask, contradiction=0.0)
        log_density = -each.excess.sum(-1).reshape(at.shape) - at.square() / 2
        if zoom == ZOOMS:  # the lowest energy suffices to find the nodes
            axes = torch.eye(3, dtype=torch.float64) if plane is None else plane.directions.double()
            log_volume = torch.linalg.slogdet(axes.mT @ each.covariance @ axes)[1] / 2
            log_density += log_volume.nan_to_num() - 3 * average * at
        weight = (log_density + nodes.square() / 2 + weights.log()).softmax(0)
        centre = (weight * at).sum(0)
        width = (weight * (at - centre).square()).sum(0).sqrt().maximum(width / 4)
    best = fuse(_grown(own, deviations, centre), pose, plane, mask, contradiction)
    return replace(best, mixture=Mixture(each, weight, (average * centre).exp()))


def _grown(own: ProjectedHuber, deviations: Tensor, at: Tensor) -> ProjectedHuber:
    return ProjectedHuber(own.mu_xy, own.mu_z * (deviations * at[..., None]).exp(), own.A, own.a, validate_args=False)
