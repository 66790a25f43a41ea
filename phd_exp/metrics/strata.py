"""Strata: named parts of a data set, each sample in exactly one."""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def strata(
    name: str, values: Float[Tensor, " samples"], edges: Sequence[float] | int, unit: str = ""
) -> dict[str, Bool[Tensor, " samples"]]:
    """Label -> which samples; split at ascending edges, or into n >= 1 parts of about equal size, none of them empty.

    A part includes its lower edge; only the last includes its upper edge. Values outside all edges are `below` or
    `above`, NaN is `unknown`. Labels read `depth 3.0-3.5 m`.

    Examples:
        >>> list(strata("depth", torch.tensor([3.0, 3.5, 4.0]), (3.0, 3.5, 4.0), "m"))
        ['depth 3-3.5 m', 'depth 3.5-4 m']
    """
    values = values.double()
    known = values[~values.isnan()]
    if isinstance(edges, int):
        shares = torch.linspace(0, 1, edges + 1, dtype=torch.float64)
        borders = known.quantile(shares).unique().tolist() if len(known) else []  # fewer if many values are equal
    else:
        borders = [float(edge) for edge in edges]
    parts = {}
    if borders:
        rule = f".{_decimals(borders)}f" if isinstance(edges, int) else "g"
        words, suffix = [format(border, rule) for border in borders], f" {unit}" if unit else ""
        parts[f"{name} below {words[0]}{suffix}"] = values < borders[0]
        for (low, high), (low_word, high_word) in zip(pairwise(borders), pairwise(words), strict=True):
            inside = (values >= low) & ((values <= high) if high == borders[-1] else (values < high))
            parts[f"{name} {low_word}-{high_word}{suffix}"] = inside
        if len(borders) == 1:
            parts[f"{name} {words[0]}{suffix}"] = values == borders[0]
        parts[f"{name} above {words[-1]}{suffix}"] = values > borders[-1]
    parts[f"{name} unknown"] = values.isnan()
    return {label: mask for label, mask in parts.items() if bool(mask.any())}


def _decimals(borders: Sequence[float]) -> int:
    """The fewest decimals with which neighbouring borders differ."""
    gaps = [high - low for low, high in pairwise(borders)]
    return max(0, -math.floor(math.log10(min(gaps)))) if gaps else 2
