"""The evolution of precision is a plain mean."""

import torch

from phd_exp.metrics.precision import Precision


def test_means_over_all_batches() -> None:
    a, log_det_A = torch.tensor([1.0, 2.0, 6.0]), torch.tensor([0.0, 1.0, 2.0])
    metric = Precision()
    metric.update(a[:2], log_det_A[:2])
    metric.update(a[2:], log_det_A[2:])
    values = metric.compute()
    torch.testing.assert_close(values["depth_precision"], torch.tensor(3.0, dtype=torch.float64))
    torch.testing.assert_close(values["projected_precision"], log_det_A.double().exp().mean())
