"""Averaging and inverse-covariance fusion, the references."""

import numpy as np
import torch

from phd_exp.fusion import average, gaussian_fusion

GENERATOR = torch.Generator().manual_seed(0)
MEANS = torch.randn(5, 4, 3, generator=GENERATOR, dtype=torch.float64)
ROOTS = torch.randn(5, 4, 3, 3, generator=GENERATOR, dtype=torch.float64)
COVARIANCES = ROOTS @ ROOTS.mT + 0.1 * torch.eye(3, dtype=torch.float64)
MASK = torch.tensor([[True, True, False, True]] * 5)


def test_it_solves_the_whitened_least_squares_problem() -> None:
    """Against numpy's lstsq of C_i^(-1/2) (v - v_i) = 0."""
    point, covariance = gaussian_fusion(MEANS, COVARIANCES)
    for i in range(5):
        whiteners = [np.linalg.inv(np.linalg.cholesky(C)) for C in COVARIANCES[i].numpy()]
        rows = np.concatenate(whiteners)
        right = np.concatenate([W @ m for W, m in zip(whiteners, MEANS[i].numpy(), strict=True)])
        np.testing.assert_allclose(point[i], np.linalg.lstsq(rows, right, rcond=None)[0], rtol=1e-9)
        np.testing.assert_allclose(covariance[i], np.linalg.inv(rows.T @ rows), rtol=1e-9)


def test_equal_covariances_give_the_average() -> None:
    point, covariance = gaussian_fusion(MEANS, COVARIANCES[:1, :1].expand(5, 4, 3, 3))
    torch.testing.assert_close(point, average(MEANS))
    torch.testing.assert_close(covariance, COVARIANCES[:1, 0].expand(5, 3, 3) / 4)


def test_the_average_leaves_out_a_masked_camera_whatever_it_holds() -> None:
    means = MEANS.clone()
    means[:, 2] = torch.nan
    torch.testing.assert_close(average(means, MASK), average(MEANS[:, MASK[0]]))
