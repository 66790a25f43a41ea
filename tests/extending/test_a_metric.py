"""A metric is a pure function of tensors that returns one number a sample.

It would stand in `metrics/errors.py`. In `training/predictions.py`, a line of `columns` records it for each
test sample, and a line of `MEANS` logs its mean.
"""

import torch
from torch import Tensor

from phd_exp.metrics.rows import Rows


def angle(xyz: Tensor, estimate: Tensor) -> Tensor:
    """Between the rays to the true position and to the estimate, radians."""
    return torch.atan2(torch.linalg.cross(xyz, estimate).norm(dim=-1), (xyz * estimate).sum(-1))


def test_a_function_makes_a_metric() -> None:
    xyz, estimate = torch.randn(2, 50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    reference = torch.nn.functional.cosine_similarity(xyz, estimate, dim=-1).acos()
    torch.testing.assert_close(angle(xyz, estimate), reference)

    table = Rows()
    for rows in (slice(0, 3), slice(3, 50)):
        table.update({"angle": angle(xyz[rows], estimate[rows])})
    torch.testing.assert_close(table.columns()["angle"], reference)
