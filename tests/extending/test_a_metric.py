"""A metric is a pure function of tensors, a number a sample; `Means` adds it up, whatever the batches and processes.

It would stay in `metrics/errors.py`, and a line of `quantities` in `training/predictions.py` would record it.
"""

import torch
from torch import Tensor

from phd_exp.metrics.means import Means


def angle(xyz: Tensor, estimate: Tensor) -> Tensor:
    """Between the rays to the true position and to the estimate, radians."""
    return torch.atan2(torch.linalg.cross(xyz, estimate).norm(dim=-1), (xyz * estimate).sum(-1))


def test_a_function_makes_a_metric() -> None:
    xyz, estimate = torch.randn(2, 50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    reference = torch.nn.functional.cosine_similarity(xyz, estimate, dim=-1).acos()
    torch.testing.assert_close(angle(xyz, estimate), reference)

    means = Means(["angle"])
    for rows in (slice(0, 3), slice(3, 50)):
        means.update({"angle": angle(xyz[rows], estimate[rows])})
    torch.testing.assert_close(means.compute()["angle"], reference.mean())
