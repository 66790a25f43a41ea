"""The optimum of each problem of a batch, found the way its device is best at."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.fusion import newton
from phd_exp.fusion import polish as polishing
from phd_exp.fusion.views import Unknown, Views

Multipliers = Float[Tensor, "cameras problems"]


def minimise(views: Views, u: Unknown, least: float) -> tuple[Unknown, Multipliers]:
    """See `newton.minimise`."""
    if views.a.device.type != "cpu":
        return newton.minimise(views, u, least)
    from phd_exp.fusion import (
        scalar,
    )  # a second of imports, and compilation where nothing was compiled before

    result = _rows(u)
    lam = scalar.minimise(*_problems(views), result, least)
    return torch.from_numpy(result).T, torch.from_numpy(lam).T


def polish(views: Views, u: Unknown, lam: Multipliers) -> tuple[Unknown, Multipliers]:
    """See `polish.polish`."""
    if views.a.device.type != "cpu":
        return polishing.polish(views, u, lam)
    from phd_exp.fusion import scalar

    result, multipliers = _rows(u), _rows(lam)
    scalar.polish(*_problems(views), result, multipliers)
    return torch.from_numpy(result).T, torch.from_numpy(multipliers).T


def _problems(views: Views) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Slope, view of the origin and precision, the problems first."""
    slope, at_origin = views.slope.permute(3, 2, 0, 1), views.at_origin.permute(2, 1, 0)
    return slope.contiguous().numpy(), at_origin.contiguous().numpy(), views.a.T.contiguous().numpy()


def _rows(columns: Float[Tensor, "n problems"]) -> Float[np.ndarray, "problems n"]:
    """A copy, the problems first."""
    return columns.T.clone(memory_format=torch.contiguous_format).numpy()
