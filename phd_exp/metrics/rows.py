"""The rows of an evaluation: every score of a split is computed from one table."""

from collections.abc import Mapping

import torch
from jaxtyping import Float, Real
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat


class Rows(Metric):
    """Collects named columns, one row per sample, over batches and processes.

    `columns` returns them in float64 on the CPU, sorted by the column `row` if there is one: the result does not
    depend on how samples are distributed. A checkpoint in the middle of an epoch includes the rows so far. Two
    thousand rows of thirty columns take 0.5 MB.

    Examples:
        >>> rows = Rows()
        >>> rows.update({"row": torch.tensor([1, 0]), "error": torch.tensor([0.5, 0.25])})
        >>> rows.columns()["error"].tolist()
        [0.25, 0.5]
    """

    full_state_update = False
    parts: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        self.names: tuple[str, ...] = ()
        self.add_state("parts", [], dist_reduce_fx="cat", persistent=True)

    def update(self, columns: Mapping[str, Real[Tensor, " rows"]]) -> None:
        """Add rows. Raises ValueError if the columns differ from those of earlier rows."""
        if self.names and self.names != tuple(columns):
            raise ValueError(f"expected columns {self.names}, got {tuple(columns)}")
        self.names = tuple(columns)
        self.parts.append(torch.stack([column.detach().double() for column in columns.values()], dim=-1))

    def compute(self) -> Float[Tensor, "rows columns"]:
        """The whole table, in the order of `names`."""
        return dim_zero_cat(self.parts).cpu()

    def columns(self) -> dict[str, Float[Tensor, " rows"]]:
        """All rows of all processes by column; `compute` alone would turn a single row into scalars."""
        table = self.compute().reshape(-1, len(self.names))
        columns = dict(zip(self.names, table.unbind(-1), strict=True))
        if "row" not in columns:
            return columns
        order = columns["row"].argsort()
        return {name: column[order] for name, column in columns.items()}
