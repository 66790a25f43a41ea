"""Strata: named parts of a data set, each sample in exactly one."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor


@dataclass(frozen=True)
class Stratum:
    """A part of the samples and its label."""

    label: str
    mask: Bool[Tensor, " samples"]


def strata(
    name: str, values: Float[Tensor, " samples"], edges: Sequence[float] | int, unit: str = ""
) -> list[Stratum]:
    """Split samples at ascending edges, or into n >= 1 parts of about equal size; empty parts are left out.

    A part includes its lower edge; only the last includes its upper edge. Values outside all edges are `below` or
    `above`, NaN is `unknown`. Labels read `depth 3.0-3.5 m`.

    Examples:
        >>> [part.label for part in strata("depth", torch.tensor([3.0, 3.5, 4.0]), (3.0, 3.5, 4.0), "m")]
        ['depth 3-3.5 m', 'depth 3.5-4 m']
    """
    values = values.double()
    known = values[~values.isnan()]
    if isinstance(edges, int):
        shares = torch.linspace(0, 1, edges + 1, dtype=torch.float64)
        borders = known.quantile(shares).unique().tolist() if len(known) else []  # fewer if many values are equal
    else:
        borders = [float(edge) for edge in edges]
    if not borders:
        return _named([(f"{name} unknown", values.isnan())])
    rule = f".{_decimals(borders)}f" if isinstance(edges, int) else "g"
    words, suffix = [format(border, rule) for border in borders], f" {unit}" if unit else ""
    parts = [(f"{name} below {words[0]}{suffix}", values < borders[0])]
    for (low, high), (low_word, high_word) in zip(pairwise(borders), pairwise(words), strict=True):
        inside = (values >= low) & ((values <= high) if high == borders[-1] else (values < high))
        parts.append((f"{name} {low_word}-{high_word}{suffix}", inside))
    if len(borders) == 1:
        parts.append((f"{name} {words[0]}{suffix}", values == borders[0]))
    parts.append((f"{name} above {words[-1]}{suffix}", values > borders[-1]))
    parts.append((f"{name} unknown", values.isnan()))
    return _named(parts)


def _decimals(borders: Sequence[float]) -> int:
    """The fewest decimals with which neighbouring borders differ."""
    gaps = [high - low for low, high in pairwise(borders)]
    return max(0, -math.floor(math.log10(min(gaps)))) if gaps else 2


def _named(parts: Sequence[tuple[str, Tensor]]) -> list[Stratum]:
    return [Stratum(label, mask) for label, mask in parts if bool(mask.any())]
