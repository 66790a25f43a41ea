"""The parameters of the Projected Huber distribution as its density uses them, the maps to them, and their checks.

Products and logarithms replace mu_xy, mu_z, A and a, which overflow or underflow for large raw numbers of a network.
The density needs no inverse of a matrix.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import constraints
from torch.distributions.constraints import Constraint

from phd_exp.distributions import spd
from phd_exp.distributions.special import signed_log1p

LARGEST_RATIO = 100.0
"""Of the eigenvalues of B, and so of A. Larger ones, on unusual images, were useless."""
_EVENT_DIMS = {"A_xy": 2, "nu_xy": 1, "k": 1}
LARGEST_RAW = 1e9  # squares of larger raw numbers, and their products, would overflow in float32
CONSTRAINTS: dict[str, Constraint] = {
    "mu_xy": constraints.real_vector,
    "mu_z": constraints.positive,
    "A": constraints.positive_definite,
    "a": constraints.positive,
    "k": constraints.real_vector,
    "raw": constraints.independent(constraints.interval(-LARGEST_RAW, LARGEST_RAW), 1),
    "f": constraints.positive,
    "S": constraints.positive,
    "mu_z0": constraints.positive,
}


@dataclass(frozen=True)
class Natural:
    """The parameters of a batch: q = A_xy (x, y) - nu_xy z + k a (t - 1) and log t = log z - log mu_z.

    The paper's axis, the line q = 0, passes through the camera: k = 0. The last term of a free axis stays apart from
    the others, because the two would cancel at the mode.

    Args:
        A_xy: A / mu_z, precision of (x, y) at any depth, 1/metres.
        nu_xy: A_xy mu_xy, 1/metres.
        log_det_A_xy: log|A_xy|; finite where |A_xy| underflows.
        log_mu_z: log of the depth's centre, mu_z in metres.
        log_a: log of the depth's precision.
        k: turns the axis about the mode; None for the paper's.
        rounding: the r of `phd_exp.distributions.rounded`; 0 for the paper's law of depth.
    """

    A_xy: Float[Tensor, "*#batch 2 2"]
    nu_xy: Float[Tensor, "*#batch 2"]
    log_det_A_xy: Float[Tensor, "*#batch"]
    log_mu_z: Float[Tensor, "*#batch"]
    log_a: Float[Tensor, "*#batch"]
    k: Float[Tensor, "*#batch 2"] | None = None
    rounding: float = 0.0

    @classmethod
    def from_camera_frame(
        cls,
        mu_xy: Float[Tensor, "*#batch 2"],
        mu_z: Float[Tensor, "*#batch"],
        A: Float[Tensor, "*#batch 2 2"],
        a: Float[Tensor, "*#batch"],
        k: Float[Tensor, "*#batch 2"] | None = None,
        rounding: float = 0.0,
    ) -> "Natural":
        """From the centre and precision of (x, y)/z and of z (metres), the k of a free axis and the rounding.

        Source: paper, section "Projected Huber distribution".
        """
        A_xy = A / mu_z[..., None, None]
        log_mu_z = mu_z.log()
        log_det_A_xy = spd.log_det(A) - 2 * log_mu_z
        return cls(A_xy, spd.matvec(A_xy, mu_xy), log_det_A_xy, log_mu_z, a.log(), k, rounding)

    @classmethod
    def from_raw(
        cls, raw: Float[Tensor, "*#batch n"], f: Float[Tensor, "*#batch"], S: float, mu_z0: float
    ) -> "Natural":
        """From seven raw numbers (n_1, n_2, b_1, b_2, b_3, w_1, w_2) of a network and its camera, or nine with k.

        In the frame of the network nu_p = (n_1, n_2), B = `precision`(b_1, b_2, b_3), a = `positive`(w_1) and
        log nu_z = sign(w_2) log(1 + |w_2|/a). Then mu_z = nu_z mu_z0 f, A_xy = 2 B / (S mu_z0) and
        nu_xy = nu_p / (mu_z0 f): in both frames, nu_z does not affect the projection. k is the same in both.

        Source: paper, sections "Parameter remapping" and "Enforcing constraints on distribution parameters".
        """
        B, log_det_B = precision(raw[..., 2:5])
        log_a = spd.log_positive(raw[..., 5])
        f_in_metres = mu_z0 * f  # the depth at which z_p = 1
        scale = 2 / (S * mu_z0)
        return cls(
            A_xy=scale * B,
            nu_xy=raw[..., :2] / f_in_metres[..., None],
            log_det_A_xy=log_det_B + 2 * math.log(scale),
            log_mu_z=signed_log1p(raw[..., 6], log_a) + f_in_metres.log(),
            log_a=log_a,
            k=raw[..., 7:] if raw.shape[-1] > 7 else None,
        )

    @property
    def slope(self) -> Float[Tensor, "*batch 2"]:
        """A_xy m_xy with the slope m_xy of the axis, 1/metres."""
        return (
            self.nu_xy if self.k is None else self.nu_xy - self.k * torch.exp(self.log_a - self.log_mu_z)[..., None]
        )

    def turn(self, z: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch 2"]:
        """k a (t - 1), the further term of q with a free axis, at depths z (metres)."""
        assert self.k is not None
        # a t, because t itself may overflow where a underflows
        return self.k * (torch.exp(self.log_a - self.log_mu_z) * z - self.log_a.exp())[..., None]

    def tempered(
        self, projected: Float[Tensor, "*#batch"] | float, depth: Float[Tensor, "*#batch"] | float
    ) -> "Natural":
        """The parameters with A / projected and a / depth in place of A and a, around the same mode and axis."""
        projected, depth = (torch.as_tensor(one).to(self.log_a) for one in (projected, depth))
        across = projected[..., None]
        return replace(
            self,
            A_xy=self.A_xy / across[..., None],
            nu_xy=self.nu_xy / across,
            log_det_A_xy=self.log_det_A_xy - 2 * projected.log(),
            log_a=self.log_a - depth.log(),
            k=None if self.k is None else self.k * (depth[..., None] / across),
        )

    @property
    def batch_shape(self) -> torch.Size:
        """The common batch shape of the parameters."""
        first, *others = (_batch_shape(name, value) for name, value in self._tensors.items())
        if all(shape == first for shape in others):  # broadcasting takes 50 us
            return first
        return torch.broadcast_shapes(first, *others)

    def expand(self, batch_shape: torch.Size) -> "Natural":
        """The same parameters with a larger batch shape; nothing is copied."""
        return self.map(lambda name, value: value.expand(batch_shape + value.shape[len(_batch_shape(name, value)) :]))

    def map(self, change: Callable[[str, Tensor], Tensor]) -> "Natural":
        """A function of the name and value of each parameter."""
        changed = {name: change(name, value) for name, value in self._tensors.items()}
        return type(self)(**changed, rounding=self.rounding)

    @property
    def _tensors(self) -> dict[str, Tensor]:
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}


def precision(b: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2 2"], Float[Tensor, "*batch"]]:
    """B = `spectral_map`(b) and log|B|, with the lesser eigenvalue raised to 1/`LARGEST_RATIO` of the greater."""
    return spd.spectral_map(spd.conditioned(b, LARGEST_RATIO))


def _batch_shape(name: str, value: Tensor) -> torch.Size:
    return torch.Size(value.shape[: value.ndim - _EVENT_DIMS.get(name, 0)])


def require(**values: Tensor | float | None) -> None:
    """Raise a ValueError that names the parameter, its shape, its constraint and an invalid value."""
    for name, value in ((name, torch.as_tensor(value)) for name, value in values.items() if value is not None):
        constraint = CONSTRAINTS[name]
        if value.numel() == 0:  # which torch's constraints cannot check
            continue
        # a constraint on vectors or matrices gives one result for each of them
        batch = value.shape[: value.ndim - constraint.event_dim]
        invalid = ~(constraint.check(value) & value.isfinite().reshape((*batch, -1)).all(-1))
        if bool(invalid.any()):
            raise ValueError(
                f"{name} of shape {tuple(value.shape)} must be finite and satisfy {constraint}, "
                f"but {int(invalid.sum())} of {invalid.numel()} do not, the first {value[invalid][0].tolist()}"
            )


def require_positions(xyz: Tensor, batch_shape: torch.Size) -> None:
    """Raise ValueError unless these are positions for a batch of this shape, without NaN."""
    if xyz.ndim == 0 or xyz.shape[-1] != 3:
        raise ValueError(f"positions: got shape {tuple(xyz.shape)}; expected 3 as the last dimension")
    try:
        torch.broadcast_shapes(xyz.shape[:-1], batch_shape)
    except RuntimeError as error:
        shapes = f"{tuple(xyz.shape[:-1])}; expected one that broadcasts with {tuple(batch_shape)}"
        raise ValueError(f"positions: got batch shape {shapes}") from error
    if bool(xyz.isnan().any()):
        raise ValueError(f"positions: got NaN in {int(xyz.isnan().any(dim=-1).sum())} of them; expected numbers")
