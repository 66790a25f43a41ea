"""The parameters of the Projected Huber distribution in the form in which its density needs them, and the maps to it.

Products and logarithms are kept in place of mu_xy, mu_z, A and a, because these overflow or underflow for raw numbers
of a network that are merely large; and no matrix is inverted and multiplied back on the way to the density.
"""

import math
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions import spd
from phd_exp.distributions.special import signed_log1p

_EVENT_DIMS = {"A_xy": 2, "nu_xy": 1}


@dataclass(frozen=True)
class Natural:
    """The parameters of a batch: q = A_xy (x, y) - nu_xy z and log t = log z - log mu_z.

    Args:
        A_xy: A / mu_z, precision of (x, y) at any depth, 1/metres.
        nu_xy: A_xy mu_xy, 1/metres.
        log_det_A_xy: log|A_xy|; finite where |A_xy| underflows.
        log_mu_z: log of the depth's centre, mu_z in metres.
        log_a: log of the depth's precision.
    """

    A_xy: Float[Tensor, "*#batch 2 2"]
    nu_xy: Float[Tensor, "*#batch 2"]
    log_det_A_xy: Float[Tensor, "*#batch"]
    log_mu_z: Float[Tensor, "*#batch"]
    log_a: Float[Tensor, "*#batch"]

    @classmethod
    def from_camera_frame(
        cls,
        mu_xy: Float[Tensor, "*#batch 2"],
        mu_z: Float[Tensor, "*#batch"],
        A: Float[Tensor, "*#batch 2 2"],
        a: Float[Tensor, "*#batch"],
    ) -> "Natural":
        """From the centre and precision of (x, y)/z and of z (metres).

        Source: paper, section "Projected Huber distribution".
        """
        A_xy = A / mu_z[..., None, None]
        log_mu_z = mu_z.log()
        return cls(A_xy, spd.matvec(A_xy, mu_xy), spd.log_det(A) - 2 * log_mu_z, log_mu_z, a.log())

    @classmethod
    def from_raw(
        cls, raw: Float[Tensor, "*#batch 7"], f: Float[Tensor, "*#batch"], S: float, mu_z0: float
    ) -> "Natural":
        """From seven raw numbers (n_1, n_2, b_1, b_2, b_3, w_1, w_2) of a network and the camera it was told.

        In the frame of the network nu_p = (n_1, n_2), B = `spectral_map`(b_1, b_2, b_3), a = `positive`(w_1) and
        log nu_z = sign(w_2) log(1 + |w_2|/a). Then mu_z = nu_z mu_z0 f, A_xy = 2 B / (S mu_z0) and
        nu_xy = nu_p / (mu_z0 f): in camera frame and network frame alike, nu_z leaves the projection alone.

        Source: paper, sections "Parameter remapping" and "Enforcing constraints on distribution parameters".
        """
        B, log_det_B = spd.spectral_map(raw[..., 2:5])
        log_a = spd.log_positive(raw[..., 5])
        f_in_metres = mu_z0 * f  # the depth at which z_p = 1
        scale = 2 / (S * mu_z0)
        return cls(
            A_xy=scale * B,
            nu_xy=raw[..., :2] / f_in_metres[..., None],
            log_det_A_xy=log_det_B + 2 * math.log(scale),
            log_mu_z=signed_log1p(raw[..., 6], log_a) + f_in_metres.log(),
            log_a=log_a,
        )

    def tempered(self, projected: float, depth: float) -> "Natural":
        """The parameters with A / projected and a / depth in place of A and a; mu_xy and mu_z stay."""
        return type(self)(
            A_xy=self.A_xy / projected,
            nu_xy=self.nu_xy / projected,
            log_det_A_xy=self.log_det_A_xy - 2 * math.log(projected),
            log_mu_z=self.log_mu_z,
            log_a=self.log_a - math.log(depth),
        )

    @property
    def batch_shape(self) -> torch.Size:
        """The common batch shape of the parameters."""
        first, *others = (self._batch_shape_of(field.name) for field in fields(self))
        if all(shape == first for shape in others):  # broadcasting takes 50 us
            return first
        return torch.broadcast_shapes(first, *others)

    def expand(self, batch_shape: torch.Size) -> "Natural":
        """The same parameters with a larger batch shape; nothing is copied."""
        expanded = {}
        for field in fields(self):
            value = getattr(self, field.name)
            expanded[field.name] = value.expand(
                batch_shape + value.shape[len(self._batch_shape_of(field.name)) :]
            )
        return type(self)(**expanded)

    def _batch_shape_of(self, name: str) -> torch.Size:
        value = getattr(self, name)
        return torch.Size(value.shape[: value.ndim - _EVENT_DIMS.get(name, 0)])
