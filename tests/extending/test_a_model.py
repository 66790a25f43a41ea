"""A baseline is a chart; this one would stay in `geometry/charts.py`, and a file of `conf/model/` would name it."""

import torch
from torch import Tensor

from phd_exp.geometry import Camera, Chart, DepthScale, projected
from phd_exp.models.heads import ChartHead


class MetricDepth(Chart):
    def __init__(self, depth: DepthScale) -> None:
        self.middle = torch.tensor([0.0, 0.0, depth.z_centre])

    def coordinates(self, xyz: Tensor, camera: Camera) -> Tensor:
        return torch.cat([projected(xyz, camera), xyz[..., 2:]], dim=-1) - self.middle

    def position(self, coordinates: Tensor, camera: Camera) -> Tensor:
        v_p, z = (coordinates + self.middle).split([2, 1], dim=-1)
        return torch.cat([v_p * z * camera.S / (2 * camera.f[..., None]), z], dim=-1)

    def log_abs_det_jacobian(self, xyz: Tensor, camera: Camera) -> Tensor:
        return 2 * torch.log(2 * camera.f / (camera.S * xyz[..., 2]))


def test_a_chart_makes_a_baseline() -> None:
    xyz, camera = torch.tensor([[0.1, -0.2, 4.5]]), Camera(torch.tensor([1550.0]), 224.0)
    head = ChartHead(DepthScale.from_ranges((1200.0, 2000.0), (3.0, 5.0)), MetricDepth)
    torch.testing.assert_close(head(head.chart.coordinates(xyz, camera), camera).mode, xyz)
