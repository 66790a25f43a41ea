"""The mixture of an ensemble's predictions, and the single Projected Huber distribution closest to it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions import spd
from phd_exp.distributions.density import quantile_between
from phd_exp.distributions.huber import RADIAL_NORMALISER
from phd_exp.distributions.kinked import Kinked
from phd_exp.distributions.projected_huber import ProjectedHuber
from phd_exp.distributions.rounded import Rounded, depth_law
from phd_exp.distributions.special import expint_differences

DRAWS = 10_240  # for a level, whose standard error is at most 0.5 / sqrt(DRAWS) = 0.0049
_AT_ONCE = 512  # draws in memory at a time
_STEPS = 20  # of weighted least squares; each removes about two thirds of the error
_DEPTHS, _ANGLES, _GOLDEN = 4, 4, 0.6180339887498949  # nodes on each side of a mode and around its axis; their turn
_PARTS, _ROUNDS = 16, 8  # an interval is divided into parts, and one of them again


@dataclass(frozen=True, eq=False)
class Mixture:
    """Projected Huber distributions with equal weights: density, moments and levels of an ensemble.

    Args:
        members: its last batch dimension counts the members; the others are the batch of the mixture.

    Examples:
        >>> raw = torch.tensor([[9.0, 0, 9, 0, 9, 9, 9], [-9, 0, 9, 0, 9, 9, 9]], dtype=torch.float64)
        >>> Mixture(ProjectedHuber.from_raw(raw, f=1500.0, S=224.0, mu_z0=2.5e-3)).closest
        ProjectedHuber(batch_shape=())
    """

    members: ProjectedHuber

    def log_prob(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """Log density of a position (metres), nats per cubic metre."""
        return self.members.log_prob(xyz[..., None, :]).logsumexp(-1) - math.log(self.members.batch_shape[-1])

    @property
    def mean(self) -> Float[Tensor, "*batch 3"]:
        """Expected position, metres."""
        return self.members.mean.mean(-2)

    @property
    def covariance_matrix(self) -> Float[Tensor, "*batch 3 3"]:
        """Covariance of the position, square metres: the mean of the members' and the covariance of their means."""
        apart = self.members.mean - self.mean[..., None, :]
        return (self.members.covariance_matrix + apart[..., :, None] * apart[..., None, :]).mean(-3)

    @property
    def disagreement(self) -> Float[Tensor, "*batch"]:
        """The mean KL divergence, nats, of the members' Gaussians from the mixture's: (log|C| - mean log|C_k|) / 2.

        0 if all members are equal, without upper bound; a Gaussian has the mean and covariance of its distribution.
        Source: own derivation; the traces cancel. It ranks unfamiliar images slightly better than the KL divergence
        of the members from `closest`.
        """
        return (self.covariance_matrix.logdet() - self.members.covariance_matrix.logdet().mean(-1)) / 2

    def depth_cdf(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
        """P(depth <= z), z in metres; 0 for z <= 0."""
        return self.members.depth_cdf(z[..., None]).mean(-1)

    def depth_icdf(self, p: Float[Tensor, "*#batch"] | float) -> Float[Tensor, "*#batch"]:
        """The depth z, metres, with P(depth <= z) = p, for p in (0, 1), by bisection."""
        p = torch.as_tensor(p, dtype=self.members.a.dtype, device=self.members.a.device)
        ends = self.members.depth_icdf(p[..., None])
        return quantile_between(self.depth_cdf, p, ends)

    def rsample(
        self, sample_shape: Sequence[int] = (), generator: torch.Generator | None = None
    ) -> Float[Tensor, "*shape 3"]:
        """Exact samples, differentiable in the members' parameters."""
        drawn = self.members.rsample(sample_shape, generator)
        which = torch.rand(drawn.shape[:-1], generator=generator, device=drawn.device).argmax(-1)
        return drawn.gather(-2, which[..., None, None].expand(*which.shape, 1, 3)).squeeze(-2)

    def level(self, xyz: Float[Tensor, "*batch 3"], seed: int = 0) -> Float[Tensor, "*batch"]:
        """Credible level of a position: the share of at least 10,240 draws, equally many of each member, whose
        density is higher. Its standard error is below 0.005.
        """
        log_p = self.log_prob(xyz)
        generator = torch.Generator(device=xyz.device).manual_seed(seed)
        each = math.ceil(_AT_ONCE / self.members.batch_shape[-1])
        rounds = DRAWS // _AT_ONCE
        inside = torch.zeros_like(log_p)
        for _ in range(rounds):
            drawn = self.members.rsample((each,), generator).movedim(-2, 0)
            inside += (self.log_prob(drawn) > log_p).to(log_p).mean((0, 1))
        return inside / rounds

    @cached_property
    def closest(self) -> ProjectedHuber:
        """The Projected Huber distribution p with the least KL(mixture || p): that of maximum E[log p].

        -E[log p] is a function of A_xy, A_xy m_xy and A_xy apex, convex, plus one of (mu_z, a); each has its minimum
        by itself. Its axis is free if the members' are. The nodes leave a few thousandths of a nat where members lie
        far apart and are wide in depth, otherwise less.

        Source: own derivation; checked against a general optimiser in tests/distributions/test_mixture.py.
        """
        members = self.members
        first, first_mu_z = members.mu_xy[..., 0, :], members.mu_z[..., :1]
        rounding = members.rounding
        log_ratio, a = (_closest_rounded_depth if rounding else _closest_depth)(members)
        z, xy, slope, A_xy = _closest_projection(members)
        mu_z = first_mu_z[..., 0] * log_ratio.exp()
        A = A_xy * mu_z[..., None, None]
        further = first_mu_z * torch.expm1(log_ratio)[..., None]
        on_first = first * first_mu_z + members.m_xy[..., 0, :] * further
        mu_xy = (on_first + xy + slope * (further - z)) / mu_z[..., None]
        apex = members.apex[..., 0, :2] + xy - slope * (first_mu_z + z)
        k = None if members.k is None else spd.matvec(A_xy, apex) / a[..., None]
        return ProjectedHuber(mu_xy, mu_z, A, a, k, False, rounding)


def _closest_depth(members: ProjectedHuber) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """The mu_z and a that minimise the mean of a max(z/mu_z, mu_z/z) + log(mu_z N(a)) over depths of the mixture.

    mu_z is returned as its logarithm minus that of the first member. With far = E[z/mu_z; z > mu_z] and
    near = E[mu_z/z; z < mu_z] the derivatives vanish where a (far - near) = 1 and a (far + near - 1) is the mean
    excess energy of a. The first gives a; then the second determines log mu_z. Both are computed from the excess of
    far and near over the probabilities of z > mu_z and z < mu_z, since they themselves cancel where a is large. Where
    a is small, near = a e^a E_1(a) / (1 + g(a)), its value for the closest law, takes the place of the second.
    """
    first, a = members.mu_z[..., :1], members.a
    log_mu = torch.log1p((members.mu_z - first) / first)
    of_a = expint_differences(a)

    def conditions(place: Tensor) -> tuple[Tensor, Tensor]:
        """Whether log mu_z is larger than `place`, and the best a there."""
        far, near, ahead, before = _partial_moments(a, of_a, place[..., None] - log_mu)
        best = 1 / (far - near + ahead).clamp_min(torch.finfo(a.dtype).tiny)
        energy = Kinked(best.log()).mean_energy
        two, one_two, _ = expint_differences(best)
        is_flat = best < 1  # the same is then compared without a difference of large numbers
        value = torch.where(is_flat, before, (far + near) * best)
        bound = torch.where(is_flat, best * (one_two + two) / (1 + best * two), energy)
        return value < bound, energy / (far + near)

    margin = torch.log1p(4 / a)
    low, high = (log_mu - margin).amin(-1), (log_mu + margin).amax(-1)
    inner = torch.arange(1, _PARTS, device=a.device).reshape(-1, *[1] * low.ndim)
    for _ in range(_ROUNDS):
        step = (high - low) / _PARTS
        low = low + step * conditions(low + step * inner)[0].sum(0)
        high = low + step
    middle = low + step / 2
    return middle, conditions(middle)[1]


def _partial_moments(a: Tensor, of_a: tuple[Tensor, ...], distance: Tensor) -> tuple[Tensor, ...]:
    """E[t/s - 1; t > s], E[s/t - 1; t < s], P(t > s) - P(t < s) and E[s/t; t < s] of the mixture, s = e^distance.

    t is z/mu_z of a member, `of_a` its `expint_differences`; the last dimension counts the members.
    """
    second, first, third = of_a
    norm = 1 + a * second  # 1 + g, by which all are divided at the end
    beyond = 1 / a - a * third  # E[t - 1], less 1 / a - E[t - 1; t > 1]
    short = second - a * first  # 1 - E[1/t]
    x, s = a * distance.abs().exp(), distance.exp()
    decay, (two, one_two, two_three) = torch.exp(-a * torch.expm1(distance.abs())), expint_differences(x)
    is_beyond, gap = distance > 0, torch.expm1(distance.abs()) * norm
    far = torch.where(is_beyond, decay / x, beyond / s + gap + decay * a * s * two_three)
    near = torch.where(is_beyond, gap - s * short + decay * two, a * s * decay * one_two)
    ahead = torch.where(is_beyond, 2 * decay - norm, norm - 2 * a * s * decay * two)
    one = decay * (one_two + two)
    before = a * s * torch.where(is_beyond, 2 * (first + second) - one, one)
    return tuple((value / norm).mean(-1) for value in (far, near, ahead, before))


def _closest_rounded_depth(members: ProjectedHuber) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """The same for rounded modes, from the nodes of all members; see `Rounded.closest_to`.

    The search starts from the precision whose log depths have the variance of those of the mixture.
    """
    law, first = members.depth_law, members.mu_z[..., :1]
    assert isinstance(law, Rounded)
    log_mu = torch.log1p((members.mu_z - first) / first)
    middle = log_mu.mean(-1)
    log_t, share = law.nodes
    own = _variance(log_t, share)
    log_t, share = (log_t + (log_mu - middle[..., None])[..., None]).flatten(-2), (share / own.shape[-1]).flatten(-2)
    log_a = (law.log_a + own.log() / 2).mean(-1) - _variance(log_t, share).log() / 2
    place, log_a = Rounded(log_a, law.r).closest_to(log_t, share)
    return middle + place, log_a.exp()


def _variance(values: Float[Tensor, "*batch nodes"], share: Float[Tensor, "*batch nodes"]) -> Float[Tensor, "*batch"]:
    mean = (share * values).sum(-1, keepdim=True)
    return (share * (values - mean).square()).sum(-1)


def _closest_projection(
    members: ProjectedHuber,
) -> tuple[
    Float[Tensor, "*batch 1"], Float[Tensor, "*batch 2"], Float[Tensor, "*batch 2"], Float[Tensor, "*batch 2 2"]
]:
    """A point (z, (x, y)) and the slope of the axis, in the coordinates of `_nodes`, and A_xy.

    They minimise the mean of h(|q|) - log|A_xy| over the mixture, with q = A_xy times the distance of (x, y) from the
    axis at z. Unless the members' axes are free the axis passes through the camera, which is the point. h(|q|) is at
    most |q|^2 / (2 max(1, |q_0|)) + constant, with equality at q_0: where that replaces it, the axis is a weighted
    regression and A_xy^(-2) a weighted covariance C, and each such step lowers the mean. The integral is a sum over
    `_nodes`.
    """
    z, xy, weight = _nodes(members)
    pull = weight
    for _ in range(_STEPS):
        z_0, xy_0 = ((pull * v).sum(-2, keepdim=True) / pull.sum(-2, keepdim=True) for v in (z, xy))
        if members.k is None:
            z_0, xy_0 = -members.mu_z[..., :1, None], torch.zeros_like(xy_0)
        slope = (pull * (z - z_0) * (xy - xy_0)).sum(-2) / (pull * (z - z_0).square()).sum(-2)
        off = xy - xy_0 - slope[..., None, :] * (z - z_0)
        C = ((pull * off)[..., :, None] * off[..., None, :]).sum(-3)
        log_det = spd.log_det(C)
        inverse = spd.inverse(C, log_det)
        q = (off * spd.matvec(inverse[..., None, :, :], off)).sum(-1, keepdim=True).sqrt()
        pull = weight / q.clamp_min(1)
    root_det = torch.exp(-log_det / 2)[..., None, None]  # C^(-1/2) by the theorem of Cayley and Hamilton
    trace = inverse.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    A_xy = (inverse + root_det * torch.eye(2).to(C)) / (trace + 2 * root_det).sqrt()
    return z_0.squeeze(-2), xy_0.squeeze(-2), slope, A_xy


def _nodes(
    members: ProjectedHuber,
) -> tuple[Float[Tensor, "*batch nodes 1"], Float[Tensor, "*batch nodes 2"], Float[Tensor, "*batch nodes 1"]]:
    """Depths, (x, y) and weights of the `_whitened_nodes` at the `_depth_nodes` of all members.

    (x, y) are relative to the axis of the first member, and depths to that of its mode, which keeps the digits of
    narrow densities. The angles turn from each depth to the next.
    """
    nodes, weight = (torch.from_numpy(values).to(members.a) for values in _whitened_nodes())
    mu_z, mu_xy, m_xy = members.mu_z, members.mu_xy, members.m_xy
    turned = (m_xy - m_xy[..., :1, :])[..., None, :]
    z, share = _depth_nodes(members)
    apart = mu_z - mu_z[..., :1]
    at_mode = mu_z[..., None] * (mu_xy - mu_xy[..., :1, :])
    at_mode = at_mode + apart[..., None] * members.apex[..., :1, :2] / mu_z[..., :1, None]
    axis = at_mode[..., None, :] + z[..., None] * turned
    z = apart[..., None] + z
    spread = spd.inverse(members.A, members.log_det_A) * mu_z[..., None, None]
    xy = axis[..., None, :] + spd.matvec(spread[..., None, None, :, :], nodes)
    every = share[..., None] * weight / members.batch_shape[-1]
    z = z[..., None].expand_as(every)
    return z.flatten(-3)[..., None], xy.flatten(-4, -2), every.flatten(-3)[..., None]


def _depth_nodes(members: ProjectedHuber) -> tuple[Float[Tensor, "*batch depths"], Float[Tensor, "*batch depths"]]:
    """Depths beyond the mode (metres) and their shares, by Laguerre's rule for a (max(t, 1/t) - 1) on each side."""
    s, weight = (torch.from_numpy(values).to(members.a) for values in np.polynomial.laguerre.laggauss(_DEPTHS))
    a = members.a[..., None]
    farther = torch.log1p(s / a)
    log_t = torch.cat([farther, -farther], dim=-1)
    log_share = (weight.log() + s).repeat(2) - depth_law(a.log(), members.rounding).energy(log_t)
    share = (log_share + 2 * log_t.clamp_max(0)).softmax(-1)
    return members.mu_z[..., None] * torch.expm1(log_t), share


def _whitened_nodes() -> tuple[np.ndarray, np.ndarray]:
    """Gauss rules for the law of q on six radii, four within 1, in a few directions for each depth; and weights."""
    x, inner = np.polynomial.legendre.leggauss(4)
    s, outer = np.polynomial.laguerre.laggauss(2)
    r = np.concatenate([(x + 1) / 2, 1 + s])
    weight = r * np.concatenate([inner / 2 * np.exp(-(r[:4] ** 2) / 2), outer * np.exp(-0.5)])
    turn = _GOLDEN * np.arange(2 * _DEPTHS)[:, None, None]
    angle = 2 * np.pi / _ANGLES * (np.arange(_ANGLES) + turn)  # depths, 1, angles
    nodes = r[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return nodes.reshape(2 * _DEPTHS, -1, 2), np.repeat(weight, _ANGLES) / (_ANGLES * RADIAL_NORMALISER)
