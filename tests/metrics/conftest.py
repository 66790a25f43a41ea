"""Predictions whose calibration is known, and positions drawn from them."""

from collections.abc import Callable, Mapping
from functools import cache

import pytest
import torch

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import distribution_columns, draws

Columns = Mapping[str, torch.Tensor]


def predictions(n: int, seed: int = 1) -> ProjectedHuber:
    """Sharp enough in depth for its law to be Laplace's with the scale mu_z/a, by a factor of 10 in both spreads."""
    generator = torch.Generator().manual_seed(seed)
    uncertainty = 10 ** torch.rand(2, n, generator=generator, dtype=torch.float64)
    A = torch.eye(2, dtype=torch.float64) * (300 / uncertainty[0])[:, None, None]
    mu_xy = 0.1 * torch.randn(n, 2, generator=generator, dtype=torch.float64)
    mu_z = 3 + 2 * torch.rand(n, generator=generator, dtype=torch.float64)
    return ProjectedHuber(mu_xy, mu_z, A, 1e4 / uncertainty[1])


@pytest.fixture(scope="session")
def claimed() -> Callable[..., Columns]:
    """Columns of predictions whose precisions are `overconfidence` times too large and whose depth is `shift`
    predicted deviations too small."""

    @cache
    def drawn(n: int) -> tuple[ProjectedHuber, torch.Tensor]:
        truth = predictions(n)
        return truth, draws(truth, 1, seed=2)[0]

    @cache
    def columns(n: int, overconfidence: float = 1.0, shift: float = 0.0) -> Columns:
        truth, xyz = drawn(n)
        xyz = xyz * (1 + shift * truth.depth_variance.sqrt() / xyz[:, 2])[:, None]  # along the ray
        claim = truth.tempered(1 / overconfidence, 1 / overconfidence)
        return distribution_columns(claim, xyz)

    return columns
