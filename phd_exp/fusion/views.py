"""Predictions of several cameras as functions of one unknown position: everything is affine in it.

Layout: problems are last, so that one arithmetic operation serves a whole batch; cameras before them; the unknowns
u (3, or 2 on a plane) and the seen (q_x, q_y, t) come first.
"""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from phd_exp.fusion.linear import Triangle, total

Seen = Float[Tensor, "3 cameras problems"]
Unknown = Float[Tensor, "k problems"]


@dataclass(frozen=True)
class Views:
    """q = A_xy (x, y) - nu_xy z and t = z/mu_z in each camera, as affine functions of the unknowns u.

    A camera that is masked out sees q = 0 and t = 1 from everywhere and has a = 0: it adds a constant.

    Args:
        slope: d(q_x, q_y, t)/du, 1/metres.
        at_origin: (q_x, q_y, t) where u = 0.
        a: precision of the depth.
    """

    slope: Float[Tensor, "3 k cameras problems"]
    at_origin: Seen
    a: Float[Tensor, "cameras problems"]

    def subset(self, problems: Int[Tensor, " some"]) -> "Views":
        """Some of the problems, in order."""
        if len(problems) == self.a.shape[-1]:
            return self
        return Views(self.slope[..., problems], self.at_origin[..., problems], self.a[..., problems])

    def chunks(self, size: int) -> "list[Views]":
        """The problems piece by piece."""
        parts = (tensor.split(size, dim=-1) for tensor in (self.slope, self.at_origin, self.a))
        return [Views(*part) for part in zip(*parts, strict=True)]

    def seen(self, u: Unknown) -> Seen:
        """(q_x, q_y, t) at u."""
        return self.at_origin + self.moved(u)

    def moved(self, du: Unknown) -> Seen:
        """The change of (q_x, q_y, t) with a change of u."""
        return total(self.slope * du[:, None], 1)

    def gradient(self, by_seen: Seen) -> Unknown:
        """A gradient with respect to u, from one with respect to what is seen."""
        return total(total(self.slope * by_seen[:, None], 0), 1)

    def hessian(self, by_seen: Float[Tensor, "4 cameras problems"]) -> Triangle:
        """A Hessian's lower triangle, from (q_x q_x, q_x q_y, q_y q_y, t t) of one with respect to what is seen."""
        xx, xy, yy, tt = by_seen
        x, y, t = self.slope
        weighted = [
            (xx * x_i + xy * y_i, xy * x_i + yy * y_i, tt * t_i)
            for x_i, y_i, t_i in zip(x, y, t, strict=True)
        ]
        return [
            [total(wx * x[j] + wy * y[j] + wt * t[j], 0) for j in range(i + 1)]
            for i, (wx, wy, wt) in enumerate(weighted)
        ]
