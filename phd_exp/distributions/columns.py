"""A batch of distributions as columns of numbers, one row a sample, and back."""

from collections.abc import Collection, Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from phd_exp.distributions.density import Density
from phd_exp.distributions.huber import HUBER_COVARIANCE
from phd_exp.distributions.projected_huber import ProjectedHuber

Columns = dict[str, Tensor]
"""Name -> one number a sample."""

PARAMETERS = ("mu_x", "mu_y", "mu_z", "A_xx", "A_xy", "A_yy", "a")
FREE_AXIS = ("k_x", "k_y")
"""Further parameters of a distribution with a free axis."""
ROUNDING = "rounding"
"""How far the mode of depth is rounded: one number for all distributions, 0 without this column."""
COVARIANCE = ("C_xx", "C_xy", "C_xz", "C_yy", "C_yz", "C_zz")
NEES = ("nees", "nees_x", "nees_y", "nees_z")


def parameter_names(table: Collection[str]) -> tuple[str, ...]:
    """The columns of parameters that a table needs: `PARAMETERS`, and further ones if it has one of them."""
    further = (names for names in (FREE_AXIS, (ROUNDING,)) if set(names) & set(table))
    return sum(further, PARAMETERS)


def parameter_columns(distribution: ProjectedHuber) -> Columns:
    """The parameters in the camera frame that differ between samples."""
    mu_xy, A = distribution.mu_xy, distribution.A
    values = (*mu_xy.unbind(-1), distribution.mu_z, A[:, 0, 0], A[:, 0, 1], A[:, 1, 1], distribution.a)
    table = dict(zip(PARAMETERS, values, strict=True))
    return table if distribution.k is None else table | dict(zip(FREE_AXIS, distribution.k.unbind(-1), strict=True))


def to_columns(distribution: ProjectedHuber) -> Columns:
    """The columns from which `from_columns` rebuilds a batch of distributions."""
    table, rounding = parameter_columns(distribution), distribution.rounding
    return table | {ROUNDING: torch.full_like(table["a"], rounding)} if rounding else table


def from_columns(columns: Mapping[str, Tensor]) -> ProjectedHuber:
    """The distributions with the parameters of a table.

    Raises ValueError where one violates its constraint, or if the roundings differ.
    """
    mu_x, mu_y, mu_z, A_xx, A_xy, A_yy, a = (columns[name] for name in PARAMETERS)
    A = torch.stack([A_xx, A_xy, A_xy, A_yy], dim=-1).unflatten(-1, (2, 2))
    has_axis = FREE_AXIS[0] in columns
    k = torch.stack([columns[name] for name in FREE_AXIS], dim=-1) if has_axis else None
    roundings = columns.get(ROUNDING, a.new_zeros(1)).unique().tolist() or [0.0]
    if len(roundings) > 1:
        raise ValueError(f"rounding: got {roundings}; expected one number for all predictions")
    return ProjectedHuber(torch.stack([mu_x, mu_y], dim=-1), mu_z, A, a, k, rounding=roundings[0])


def distribution_columns(distribution: Density, xyz: Float[Tensor, "samples 3"]) -> Columns:
    """Mean and median depth (metres), the parameters of a Projected Huber density, of others the covariance (m^2),
    `squared_error_columns`, and how true positions (metres) stand to the prediction.

    `level` is the credible level of the position, `depth_pit` the predicted probability of a smaller depth,
    `depth_crps` the score of the depth in metres, and `nll` is in nats.
    """
    table = coordinates("mean_", distribution.mean) | {"median_z": distribution.depth_median}
    if isinstance(distribution, ProjectedHuber):
        table |= to_columns(distribution) | {"projected_precision": distribution.log_det_A.exp()}
    else:
        rows, columns = torch.triu_indices(3, 3)
        table |= dict(zip(COVARIANCE, distribution.covariance_matrix[:, rows, columns].unbind(-1), strict=True))
    table |= squared_error_columns(distribution, xyz)
    return table | {
        "level": distribution.level(xyz),
        "depth_pit": distribution.depth_cdf(xyz[:, 2]),
        "depth_crps": distribution.depth_crps(xyz[:, 2]),
        "nll": -distribution.log_prob(xyz),
    }


def coordinates(prefix: str, xyz: Float[Tensor, "samples 3"]) -> Columns:
    """The columns of positions."""
    return {f"{prefix}{axis}": xyz[:, place] for place, axis in enumerate("xyz")}


def draws(distribution: Density, n: int, seed: int) -> Float[Tensor, "n samples 3"]:
    """n positions from each distribution, the same for the same seed; torch's own random numbers stay untouched."""
    generator = torch.Generator(device=distribution.mode.device).manual_seed(seed)
    return distribution.rsample((n,), generator)


def squared_error_columns(distribution: Density, xyz: Float[Tensor, "*draws samples 3"]) -> Columns:
    """Variances and squared errors: m^2 (of depth, about its mean), and without unit (projected: x/z plus y/z)."""
    z = xyz[..., 2]
    off_centre = xyz[..., :2] / z[..., None] - distribution.projected_mean
    return {
        "depth_variance": distribution.depth_variance,
        "depth_squared_error": (z - distribution.depth_mean).square(),
        "projected_variance": distribution.projected_covariance.diagonal(dim1=-2, dim2=-1).sum(-1),
        "projected_squared_error": off_centre.square().sum(-1),
    }


def nees_columns(distribution: ProjectedHuber, xyz: Float[Tensor, "*draws samples 3"]) -> Columns:
    """The normalised estimation error squared of positions (metres): `nees`, and `nees_x`, `nees_y`, `nees_z`.

    With e the error of the mean: e . C^(-1) e = (z - E[z])^2/Var[z] + |q|^2/c, of expectation 3, and e_i^2/C_ii, of
    expectation 1. They are not chi-squared: their tails are longer.

    Source: own derivation (e is linear in the independent t and q); checked in tests/distributions/test_columns.py.
    """
    squared = (xyz - distribution.mean).square()
    across = distribution.whiten(xyz).square().sum(-1) / HUBER_COVARIANCE
    axes = (squared / distribution.variance).unbind(-1)
    return dict(zip(NEES, (squared[..., 2] / distribution.depth_variance + across, *axes), strict=True))
