"""Volumes of regions against those of ellipsoids, and at equal coverage."""

import math

import numpy as np
import pytest
import torch
from scipy import stats

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.shaped import Gaussian
from phd_exp.evaluation.conformal import conformal_log_volumes
from phd_exp.evaluation.volumes import LOG_VOLUMES, drawn_columns
from phd_exp.records.errors import RunError

N = 2000


def predictions() -> ProjectedHuber:
    """N equal ones."""
    A = torch.tensor([[300.0, 40.0], [40.0, 90.0]], dtype=torch.float64)
    mu_xy, mu_z, a = torch.tensor([0.1, -0.2]).double(), torch.tensor(4.0).double(), torch.tensor(30.0).double()
    return ProjectedHuber(mu_xy, mu_z, A, a).expand((N,))


def test_volumes_of_a_gaussian_are_those_of_ellipsoids() -> None:
    law = Gaussian(predictions(), torch.zeros(N, 2))
    found = drawn_columns(law, law.mode, seed=0)
    half_log_det = float(law.covariance_matrix[0].logdet()) / 2
    for level, name in LOG_VOLUMES.items():
        exact = math.log(4 / 3 * math.pi) + 1.5 * math.log(stats.chi2(3).ppf(level)) + half_log_det
        assert float(found[name].mean()) == pytest.approx(exact, abs=0.02 if level > 0.95 else 0.01)


def test_a_paper_density_has_the_volume_of_its_region_on_a_grid() -> None:
    law = predictions()
    z = torch.linspace(2.5, 6, 141, dtype=torch.float64)
    u = torch.linspace(-0.15, 0.15, 61, dtype=torch.float64)
    rays = law.mu_xy[0] + torch.cartesian_prod(u, u)
    xyz = torch.cat([rays, torch.ones(len(rays), 1)], dim=-1)[:, None] * z[None, :, None]
    inside = law[0].level(xyz) <= 0.9
    volume = float((inside * z.square()).sum()) * float((u[1] - u[0]) ** 2 * (z[1] - z[0]))
    found = drawn_columns(law, law.mode, seed=1)[LOG_VOLUMES[0.9]]
    assert float(found.mean()) == pytest.approx(math.log(volume), abs=0.02)


def test_the_level_of_the_volumes_is_that_with_the_coverage() -> None:
    """Between 90 and 95 % if the levels of the held-out truths are the roots of uniform ones."""
    table = {name: np.full(5, 10 * level) for level, name in LOG_VOLUMES.items()}
    uniform = np.repeat((np.arange(999) + 1) / 1000, 2)  # the samples that choose, and those that guarantee
    found = conformal_log_volumes(table, {"level": uniform})["log_volume"]
    np.testing.assert_allclose(found, 9, rtol=1e-12)
    higher = conformal_log_volumes(table, {"level": uniform**0.5})["log_volume"]
    assert (higher > 9.4).all()
    assert (higher < 9.5).all()
    with pytest.raises(RunError, match="needs at least 9 held-out samples"):
        conformal_log_volumes(table, {"level": uniform[:4]})
