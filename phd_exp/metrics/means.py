"""The one thing that is counted over an epoch: sums."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric


class Means(Metric):
    """The means of named quantities over all samples seen, whatever the sizes of their batches.

    Its state is one sum a quantity and a count, in float64: thousands of float32 additions would cost digits. A
    checkpoint in the middle of an epoch holds it.
    """

    full_state_update = False
    sums: Tensor
    count: Tensor

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = tuple(names)
        self.add_state(
            "sums", torch.zeros(len(self.names), dtype=torch.float64), dist_reduce_fx="sum", persistent=True
        )
        self.add_state("count", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum", persistent=True)

    def update(self, values: Mapping[str, Float[Tensor, " batch"]]) -> None:
        rows = torch.stack([values[name] for name in self.names]).double()
        self.sums += rows.sum(dim=-1)
        self.count += rows.shape[-1]

    def compute(self) -> dict[str, Tensor]:
        return dict(zip(self.names, self.sums / self.count, strict=True))
