"""The two columns of the paper's tables: error along the true viewing ray, and across it."""

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric

MILLIMETRES = 1000.0


def along_true_ray(
    xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """The true position moved along its own viewing ray to where the estimate projects onto that ray.

    v_par = (v . v^ / |v|^2) v, in metres.
    """
    scale = (xyz * estimate).sum(-1, keepdim=True) / xyz.square().sum(-1, keepdim=True)
    return scale * xyz


def projected_error(
    xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """|v^ - v_par|: the distance of the estimate from the true viewing ray, in metres."""
    return (estimate - along_true_ray(xyz, estimate)).norm(dim=-1)


def depth_error(
    xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """| |v_par| - |v| |: the error along the true viewing ray, in metres."""
    return (along_true_ray(xyz, estimate).norm(dim=-1) - xyz.norm(dim=-1)).abs()


class PositionErrors(Metric):
    """The mean projected and depth error of all samples seen, in millimetres."""

    full_state_update = False
    projected: Tensor
    depth: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        # float64: 8000 float32 additions would cost the last digits
        for name in ("projected", "depth", "count"):
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, xyz: Float[Tensor, "batch 3"], estimate: Float[Tensor, "batch 3"]) -> None:
        self.projected += projected_error(xyz, estimate).sum()
        self.depth += depth_error(xyz, estimate).sum()
        self.count += len(xyz)

    def compute(self) -> dict[str, Tensor]:
        return {
            "projected_error_mm": MILLIMETRES * self.projected / self.count,
            "depth_error_mm": MILLIMETRES * self.depth / self.count,
        }
