"""Calibration over an epoch in a state of fixed size, whatever the number of samples and processes."""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics import Metric

from phd_exp.metrics.calibration_scores import (
    COLUMNS,
    ORDERS,
    Order,
    calibration_scores,
    finite_rows,
    with_errors,
)
from phd_exp.metrics.ordered import Ordered

BINS = 4096
SMALLEST, LARGEST = 1e-10, 1e6
"""Variances and squared errors from (0.01 mm)^2 to (1 km)^2 are told apart to 0.9 %; those beyond share a bin."""
_SLOTS = 1 + max(len(order.sums) for order in ORDERS.values())


class Calibration(Metric):
    """`calibration_scores` of all samples seen, and how many were `left_out` because a column was not finite.

    The state is one histogram an order: of each of 4096 bins the number of samples and up to three sums, 0.8 MB in
    all. Only sums are kept, so processes add up, in whatever way the samples were dealt out. Scores differ from those
    of the samples themselves by what order is lost within a bin: areas and distances by 1/4096 at most, means not at
    all.
    """

    full_state_update = False
    sums: Tensor
    left_out: Tensor

    def __init__(self) -> None:
        super().__init__()
        state = torch.zeros(len(ORDERS), BINS, _SLOTS, dtype=torch.float64)
        self.add_state("sums", state, dist_reduce_fx="sum")
        self.add_state("left_out", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, columns: Mapping[str, Float[Tensor, " samples"]]) -> None:
        """Add samples. Raises KeyError where one of `COLUMNS` is missing."""
        finite = finite_rows(columns)
        self.left_out += (~finite).sum()
        # zeros rather than a selection, whose size a GPU would have to wait for
        values = with_errors({name: columns[name].detach().masked_fill(~finite, 0) for name in COLUMNS})
        values["count"] = finite.double()
        nothing = torch.zeros_like(values["count"])
        places, rows = [], []
        for place, order in enumerate(ORDERS.values()):
            places.append(place * BINS + _bin(order, values[order.by]))
            summed = [values[name] for name in ("count", *order.sums)]
            rows.append(torch.stack(summed + [nothing] * (_SLOTS - len(summed)), dim=-1))
        self.sums.view(-1, _SLOTS).index_add_(0, torch.cat(places), torch.cat(rows))

    def compute(self) -> dict[str, Tensor]:
        """The scores, NaN where nothing was seen."""
        orders = {
            name: Ordered(
                points=_points(order, self.sums),
                count=histogram[:, 0],
                sums={summed: histogram[:, 1 + slot] for slot, summed in enumerate(order.sums)},
            )
            for (name, order), histogram in zip(ORDERS.items(), self.sums, strict=True)
        }
        return calibration_scores(orders) | {"left_out": self.left_out}


def _is_a_probability(order: Order) -> bool:
    return order.by in ("level", "depth_pit")


def _bin(order: Order, values: Tensor) -> Tensor:
    decades = torch.log10(values / SMALLEST) / math.log10(LARGEST / SMALLEST)
    share = values if _is_a_probability(order) else decades
    return (BINS * share).clamp(0, BINS - 1).long()


def _points(order: Order, like: Tensor) -> Tensor:
    """The middle of each bin."""
    share = (torch.arange(BINS, dtype=like.dtype, device=like.device) + 0.5) / BINS
    return share if _is_a_probability(order) else SMALLEST * (LARGEST / SMALLEST) ** share
