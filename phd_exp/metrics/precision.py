"""How sure the model says it is: the paper's evolution of precision."""

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric


class Precision(Metric):
    """The mean depth precision a and the mean determinant |A| of the projected precision of all samples seen.

    Source: paper, Figure "evolution of a".
    """

    full_state_update = False
    projected: Tensor
    depth: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        for name in ("depth", "projected", "count"):
            self.add_state(name, torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, a: Float[Tensor, " batch"], log_det_A: Float[Tensor, " batch"]) -> None:
        self.depth += a.sum(dtype=torch.float64)
        self.projected += log_det_A.double().exp().sum()
        self.count += len(a)

    def compute(self) -> dict[str, Tensor]:
        return {
            "depth_precision": self.depth / self.count,
            "projected_precision": self.projected / self.count,
        }
