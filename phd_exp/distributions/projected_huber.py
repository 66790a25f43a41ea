"""The Projected Huber distribution of a position in front of a camera.

With q = A_xy (x, y) - nu_xy z + k a (t - 1) and t = z / mu_z,

    -log p(v) = h(|q|) - log|A_xy| + log(2 pi (1 + e^(-1/2))) + a max(t, 1/t) + log(mu_z N(a))   for z > 0.

q and t are independent, and v is affine in (q, t): every statistic below follows from that. In the paper's density
k = 0, and its axis, the line q = 0, passes through the camera; a free axis passes through `apex` in the plane z = 0.
The law of t may have a rounded mode in place of the kink at t = 1; then energy and normaliser are those of `Rounded`.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal, final

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution
from torch.nn.functional import pad

from phd_exp.distributions import huber, spd
from phd_exp.distributions.density import Density
from phd_exp.distributions.depth_law import DepthLaw
from phd_exp.distributions.natural import CONSTRAINTS, Natural, require, require_positions
from phd_exp.distributions.rounded import depth_law
from phd_exp.geometry.camera import at_depth


@final
class ProjectedHuber(Density, Distribution):
    """A density over positions v = (x, y, z) in the camera frame, zero for z <= 0.

    Args:
        mu_xy: centre of (x, y)/z.
        mu_z: centre of z, metres; the mode is mu_z (mu_xy, 1).
        A: precision of (x, y)/z, symmetric positive definite; (x, y)/z has covariance 3.0765 A^(-2).
        a: precision of z; Var[z] is about 2 mu_z^2/a^2 where a is large and nothing is rounded.
        k: adds k a (t - 1) to q, so that the axis, the line of centres of (x, y) given z, leaves the viewing ray of
            the mode; None for the paper's density. With k = 0 all values are those of the paper's density.
        rounding: how far the mode of depth is rounded, in units of mu_z/a; 0 for the paper's law of depth.
        validate_args: check parameters here and positions later (default: True). A check synchronises with the GPU
            and does not run under `torch.func.vmap`; pass False there.

    Raises:
        ValueError: a parameter violates its constraint, or mode or covariance overflow.

    Examples:
        >>> p = ProjectedHuber(torch.zeros(2), torch.tensor(4.0), 100 * torch.eye(2), torch.tensor(20.0))
        >>> p.mode
        tensor([0., 0., 4.])
        >>> p.log_prob(torch.tensor([0.1, 0.0, 4.2])) < p.log_prob(p.mode)  # nats per cubic metre
        tensor(True)

    Source: paper, section "Projected Huber distribution"; the free axis is an own generalisation. It keeps the
    normaliser, the law of depth, the levels and convexity, because (q, t) stays affine in v with the same slope in
    (x, y). The rounded law of depth is an own one, see `phd_exp.distributions.rounded`.
    """

    has_closed_forms: ClassVar[Literal[True]] = True
    arg_constraints = CONSTRAINTS
    has_rsample = True

    def __init__(
        self,
        mu_xy: Float[Tensor, "*#batch 2"],
        mu_z: Float[Tensor, "*#batch"],
        A: Float[Tensor, "*#batch 2 2"],
        a: Float[Tensor, "*#batch"],
        k: Float[Tensor, "*#batch 2"] | None = None,
        validate_args: bool | None = None,
        rounding: float = 0.0,
    ) -> None:
        if _wants_validation(validate_args):
            require(mu_xy=mu_xy, mu_z=mu_z, A=A, a=a, k=k)
            if not 0 <= rounding < math.inf:
                raise ValueError(f"rounding: got {rounding}; expected a finite number of at least 0")
        self._adopt(Natural.from_camera_frame(mu_xy, mu_z, A, a, k, rounding), validate_args)
        self._require_representable()

    @classmethod
    def about_axis(
        cls,
        m_xy: Float[Tensor, "*#batch 2"],
        apex: Float[Tensor, "*#batch 2"] | None,
        mu_z: Float[Tensor, "*#batch"],
        A: Float[Tensor, "*#batch 2 2"],
        a: Float[Tensor, "*#batch"],
        rounding: float = 0.0,
    ) -> "ProjectedHuber":
        """The distribution whose axis has the slope m_xy and the (x, y) of `apex` at z = 0 (metres; None: 0).

        It is not validated.
        """
        if apex is None:
            return cls(m_xy, mu_z, A, a, None, False, rounding)
        place = apex / mu_z[..., None]
        return cls(m_xy + place, mu_z, A, a, spd.matvec(A, place) / a[..., None], False, rounding)

    @classmethod
    def from_raw(
        cls,
        raw: Float[Tensor, "*#batch n"],
        *,
        f: Float[Tensor, "*#batch"] | float,
        S: float,
        mu_z0: float,
        validate_args: bool | None = None,
    ) -> "ProjectedHuber":
        """The distribution of the raw numbers (n_1, n_2, b_1, b_2, b_3, w_1, w_2) of a network, as `predict` uses it.

        Nine numbers (..., w_1, w_2, k_1, k_2) give a free axis. The lesser eigenvalue of A is raised to at least
        1/100 of the greater, a constant for the gradient; the constructor takes any A.

        Args:
            raw: the raw numbers.
            f: focal length, pixels, for each element of the batch; of shape (*, 1) for several points per camera.
            S: side of the image, pixels.
            mu_z0: the data set's depth per focal length, metres per pixel.
            validate_args: as for the constructor; without validation `log_prob` and its gradient are finite for raw
                numbers up to 1e9.

        Raises:
            ValueError: there are not seven or nine raw numbers; one is beyond +-1e9; f, S or mu_z0 is not positive
                and finite; or mode or covariance overflow.

        Source: paper, section "Enforcing constraints on distribution parameters"; formulas in `Natural.from_raw`.
        """
        if raw.shape[-1:] not in ((7,), (9,)):
            raise ValueError(f"raw: got shape {tuple(raw.shape)}; expected 7 as the last dimension, or 9 with k")
        f = torch.as_tensor(f, dtype=raw.dtype, device=raw.device)
        if _wants_validation(validate_args):
            require(raw=raw, f=f, S=S, mu_z0=mu_z0)
        distribution = cls._of(Natural.from_raw(raw, f, S, mu_z0), validate_args)
        distribution._require_representable()
        return distribution

    @classmethod
    def _of(cls, natural: Natural, validate_args: bool | None) -> "ProjectedHuber":
        distribution = cls.__new__(cls)
        distribution._adopt(natural, validate_args)
        return distribution

    def _adopt(self, natural: Natural, validate_args: bool | None) -> None:
        """Initialise from parameters that are valid."""
        batch_shape = natural.batch_shape
        self._natural = natural.expand(batch_shape)
        super().__init__(batch_shape, torch.Size([3]), validate_args=False)
        self._validate_args = _wants_validation(validate_args)

    def _require_representable(self) -> None:
        """Raise ValueError if mode or covariances overflow in the data type, unless validation is off."""
        if not self._validate_args:
            return
        covariances = (self.covariance_matrix.flatten(-2), self.projected_covariance.flatten(-2))
        overflow = ~torch.cat([self.mode, self.mean, *covariances], dim=-1).isfinite().all(-1)
        if bool(overflow.any()):
            raise ValueError(
                f"parameters: mode or covariance of {int(overflow.sum())} of {overflow.numel()} distributions "
                f"overflow in {self.mode.dtype}; expected parameters nearer to 1"
            )

    def expand(self, batch_shape: Sequence[int], _instance: Distribution | None = None) -> "ProjectedHuber":
        """The same distribution with a larger batch shape; nothing is copied."""
        return self._of(self._natural.expand(torch.Size(batch_shape)), self._validate_args)

    def __getitem__(self, row: int | slice | Tensor | tuple[int | slice | Tensor, ...] | None) -> "ProjectedHuber":
        """Some distributions of a batch, indexed like a tensor; None adds a dimension."""
        return self._of(self._natural.map(lambda _, value: value[row]), self._validate_args)

    def with_axis(self, k: Float[Tensor, "*#batch 2"]) -> "ProjectedHuber":
        """The paper's density with its axis turned about the mode; see the argument k."""
        return self._of(replace(self._natural, k=k), self._validate_args)

    def with_rounding(self, rounding: float) -> "ProjectedHuber":
        """The density with the same parameters and the mode of depth rounded by this much."""
        return self._of(replace(self._natural, rounding=rounding), self._validate_args)

    def tempered(
        self, projected: Float[Tensor, "*#batch"] | float, depth: Float[Tensor, "*#batch"] | float
    ) -> "ProjectedHuber":
        """The distribution with A / projected and a / depth in place of A and a, around the same mode and axis."""
        return self._of(self._natural.tempered(projected, depth), self._validate_args)

    def __repr__(self) -> str:
        return f"ProjectedHuber(batch_shape={tuple(self.batch_shape)})"

    @property
    def mu_xy(self) -> Float[Tensor, "*batch 2"]:
        """Centre of (x, y)/z, that of the mode."""
        return spd.matvec(self._A_xy_inverse, self._natural.nu_xy)

    @property
    def m_xy(self) -> Float[Tensor, "*batch 2"]:
        """Slope of the axis, the change of the centre of (x, y) with z; mu_xy without a free axis."""
        return spd.matvec(self._A_xy_inverse, self._natural.slope)

    @property
    def apex(self) -> Float[Tensor, "*batch 3"]:
        """Where the axis meets the plane z = 0, metres: the density of v is that of the paper at v - apex."""
        if self.k is None:
            return self._natural.log_mu_z.new_zeros(()).expand((*self.batch_shape, 3))
        return pad(spd.matvec(self._A_xy_inverse, self.k * self.a[..., None]), (0, 1))

    @property
    def k(self) -> Float[Tensor, "*batch 2"] | None:
        """The further term of q over a (t - 1); None without a free axis."""
        return self._natural.k

    @property
    def mu_z(self) -> Float[Tensor, "*batch"]:
        """Centre of z and its mode, metres."""
        return self._natural.log_mu_z.exp()

    @property
    def A(self) -> Float[Tensor, "*batch 2 2"]:
        """Precision of (x, y)/z."""
        return self._natural.A_xy * self.mu_z[..., None, None]

    @property
    def a(self) -> Float[Tensor, "*batch"]:
        """Precision of z."""
        return self._natural.log_a.exp()

    @property
    def rounding(self) -> float:
        """How far the mode of depth is rounded; 0 for the paper's law."""
        return self._natural.rounding

    @property
    def depth_law(self) -> DepthLaw:
        """The law of z/mu_z."""
        return depth_law(self._natural.log_a, self._natural.rounding)

    @property
    def log_det_A(self) -> Float[Tensor, "*batch"]:
        """log|A|; half of it is the log of the typical precision of (x, y)/z."""
        return self._natural.log_det_A_xy + 2 * self._natural.log_mu_z

    @property
    def _A_xy_inverse(self) -> Tensor:
        return spd.inverse(self._natural.A_xy, self._natural.log_det_A_xy)

    @property
    def measure(self) -> Float[Tensor, "*batch 3 3"]:
        """The matrix from a position relative to the apex (metres) to (q, t), with t = z/mu_z."""
        n = self._natural
        q = torch.cat([n.A_xy, -n.slope[..., None]], -1)
        return torch.cat([q, pad(torch.exp(-n.log_mu_z)[..., None, None], (2, 0))], -2)

    def whiten(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch 2"]:
        """The projection in units of its precision, q = A ((x, y)/z - mu_xy) t, with a free axis plus k a (t - 1)."""
        n = self._natural
        q = spd.matvec(n.A_xy, xyz[..., :2]) - n.nu_xy * xyz[..., 2:]
        return q if n.k is None else q + n.turn(xyz[..., 2])

    def log_prob(self, value: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """Log density of a position (metres), nats per cubic metre; -inf, with zero gradient, for z <= 0.

        It is -inf at infinity too. `torch.func` works; jacfwd of jacfwd raises NotImplementedError: use hessian.

        Raises:
            ValueError: the shape does not fit the batch shape, or a coordinate is NaN (if arguments are validated).

        Source: paper, section "Projected Huber distribution"; the constants are kept.
        """
        energy, visible = self._excess_energy(value)
        n = self._natural
        log_mode = n.log_det_A_xy - huber.HUBER_LOG_NORMALISER - n.log_mu_z - self.depth_law.log_normaliser
        return (log_mode - energy).masked_fill(~visible, -torch.inf)

    def _excess_energy(self, xyz: Tensor) -> tuple[Tensor, Tensor]:
        """Log density at the mode minus log density at a position, and whether that is finite with z > 0."""
        if self._validate_args:
            require_positions(xyz, self.batch_shape)
        visible = (xyz[..., 2] > 0) & (xyz.abs().amax(-1) != torch.inf)
        # other positions are replaced, so that no NaN is multiplied by a zero gradient
        xyz = xyz.masked_fill(~visible[..., None], 1)
        depth_energy = self.depth_law.energy(xyz[..., 2].log() - self._natural.log_mu_z)
        return huber.huber_energy(self.whiten(xyz)) + depth_energy, visible

    def level(self, xyz: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
        """Credible level of a position: the probability of the smallest region of highest density that contains it.

        0 at the mode, 1 far away and for z <= 0; uniform on (0, 1) over positions drawn from the distribution.
        In float32, where positions and mu_z are rounded, it errs by about 1e-7 ((|k| + 1) a + |A|): use float64 where
        that is above 1e-3.

        Source: own derivation, see `Kinked.level` and `Rounded.level`.
        """
        energy, visible = self._excess_energy(xyz)
        return self.depth_law.level(energy).masked_fill(~visible, 1)

    @property
    def mode(self) -> Float[Tensor, "*batch 3"]:
        """The position of highest density, mu_z (mu_xy, 1), metres."""
        return at_depth(self.mu_xy, self.mu_z)

    @property
    def mean(self) -> Float[Tensor, "*batch 3"]:
        """Expected position, E[z] (mu_xy, 1) - A_xy^(-1) k a E[t - 1], metres; on the axis."""
        mean = at_depth(self.mu_xy, self.depth_mean)
        if self.k is None:
            return mean
        excess = self.depth_law.excess_moments[0]
        return mean - pad(spd.matvec(self._A_xy_inverse, self.k * excess[..., None]), (0, 1))

    @property
    def covariance_matrix(self) -> Float[Tensor, "*batch 3 3"]:
        """Covariance of the position, Var[z] m m^T + c A_xy^(-2) with m = (m_xy, 1), square metres.

        Source: own derivation (q and t are independent); checked against samples.
        """
        m = pad(self.m_xy, (0, 1), value=1)
        along = self.depth_variance[..., None, None] * m[..., :, None] * m[..., None, :]
        across = huber.HUBER_COVARIANCE * spd.square(self._A_xy_inverse)
        return along + pad(across, (0, 1, 0, 1))

    @property
    def variance(self) -> Float[Tensor, "*batch 3"]:
        """Variance of each coordinate, square metres."""
        return self.covariance_matrix.diagonal(dim1=-2, dim2=-1)

    @property
    def projected_mean(self) -> Float[Tensor, "*batch 2"]:
        """Mean of (x, y)/z, m_xy + E[1/z] (x, y) of the apex: mu_xy without a free axis.

        Source: own derivation; checked against quadrature in tests/distributions/test_projected_huber.py.
        """
        if self.k is None:
            return self.mu_xy
        return self.mu_xy - self.apex[..., :2] * (self.depth_law.inverse_moments[0] / self.mu_z)[..., None]

    @property
    def projected_covariance(self) -> Float[Tensor, "*batch 2 2"]:
        """Covariance of (x, y)/z, c A^(-2) + Var[1/t] d d^T with d = m_xy - mu_xy, which is 0 without a free axis.

        Source: paper, section "Variance of projected coordinates", with the constant corrected.
        """
        across = huber.HUBER_COVARIANCE * spd.square(spd.inverse(self.A, self.log_det_A))
        if self.k is None:
            return across
        d = self.apex[..., :2] * (self.depth_law.inverse_moments[1].sqrt() / self.mu_z)[..., None]
        return across + d[..., :, None] * d[..., None, :]

    @property
    def depth_mean(self) -> Float[Tensor, "*batch"]:
        return self.mu_z * self.depth_law.moments[0]

    @property
    def depth_variance(self) -> Float[Tensor, "*batch"]:
        return self.mu_z.square() * self.depth_law.moments[1]

    def depth_cdf(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
        """P(depth <= z), z in metres; 0 for z <= 0."""
        visible = z > 0
        log_t = z.masked_fill(~visible, 1).log() - self._natural.log_mu_z
        return self.depth_law.cdf(log_t).masked_fill(~visible, 0)

    def depth_crps(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
        """Continuous ranked probability score of a depth z (metres), int (P(depth <= u) - 1[u >= z])^2 du, metres.

        Source: own derivation, see `DepthLaw.crps_beyond_distance`.
        """
        log_t = z.clamp_min(torch.finfo(z.dtype).tiny).log() - self._natural.log_mu_z
        width = torch.exp(self._natural.log_mu_z - self._natural.log_a)
        return (z - self.mu_z).abs() + width * self.depth_law.crps_beyond_distance(log_t)

    def depth_icdf(self, p: Float[Tensor, "*#batch"] | float) -> Float[Tensor, "*#batch"]:
        """The depth z, metres, with P(depth <= z) = p, for p in [0, 1]; 0 at p = 0, inf at p = 1."""
        p = torch.as_tensor(p, dtype=self._natural.log_a.dtype, device=self._natural.log_a.device)
        return torch.exp(self._natural.log_mu_z + self.depth_law.icdf(p))

    def rsample(
        self, sample_shape: torch.Size | Sequence[int] = (), generator: torch.Generator | None = None
    ) -> Float[Tensor, "*shape 3"]:
        """Exact samples, differentiable in the parameters: (x, y) = A_xy^(-1) (q + nu_xy z - k a (t - 1)).

        Source: own derivation (q and t are independent); gradients by the implicit function theorem.
        """
        shape = self._extended_shape(torch.Size(sample_shape))[:-1]
        kind: Any = {"dtype": self._natural.log_a.dtype, "device": self._natural.log_a.device, "generator": generator}
        q, p = huber.sample_whitened(shape, **kind), torch.rand(shape, **kind)
        z = self.depth_icdf(p.clamp_min(torch.finfo(p.dtype).eps / 2))  # rand may return 0, where z would be 0
        across = q + self._natural.nu_xy * z[..., None]
        xy = spd.matvec(self._A_xy_inverse, across if self.k is None else across - self._natural.turn(z))
        return torch.cat([xy, z[..., None]], dim=-1)

    def entropy(self) -> Float[Tensor, "*batch"]:
        """-E[log p], nats.

        Source: own derivation from the independence of q and t; checked against samples.
        """
        projection = huber.HUBER_LOG_NORMALISER + huber.HUBER_MEAN_ENERGY - self._natural.log_det_A_xy
        return projection + self._natural.log_mu_z + self.depth_law.log_normaliser + self.depth_law.mean_energy


def _wants_validation(validate_args: bool | None) -> bool:
    return Distribution._validate_args if validate_args is None else validate_args
