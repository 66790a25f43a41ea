"""The focal length as an input of the network."""

import pytest
import torch

from phd_exp.geometry import Camera, DepthScale, LogDepth
from phd_exp.models.backbones import resnet
from phd_exp.models.heads import ChartHead, DistributionHead
from phd_exp.models.regressor import FocalLengthInput, Regressor

F_RANGE, Z_RANGE = (1200.0, 2000.0), (3.0, 5.0)
DEPTH = DepthScale.from_ranges(F_RANGE, Z_RANGE)


def uniform(n: int, low: float, high: float, seed: int) -> torch.Tensor:
    return low + (high - low) * torch.rand(n, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def shown() -> FocalLengthInput:
    """With random weights, as after training."""
    torch.manual_seed(0)
    layer = FocalLengthInput(3, DEPTH)
    torch.nn.init.normal_(layer.last.weight)
    return layer


def test_focal_lengths_are_clamped_to_the_range_of_the_data_set(shown: FocalLengthInput) -> None:
    raw = torch.randn(1, 3).expand(4, 3)
    found = shown(raw, torch.tensor([1200.0, 2000.0, 1e5, 1e7]))
    assert (found[1] - found[0]).abs().max() > 0.01
    torch.testing.assert_close(found[3], found[2])


def test_it_learns_at_which_depths_objects_are() -> None:
    """For objects of unknown size it reaches the lower bound; z/f alone gives 336 mm."""
    torch.manual_seed(0)
    head, shown = ChartHead(DEPTH, LogDepth), FocalLengthInput(3, DEPTH)
    optimizer = torch.optim.Adam(shown.parameters(), lr=1e-2)
    for step in range(200):
        error = depth_errors(head, shown, n=1000, seed=step).mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    with torch.no_grad():
        found = 1000 * depth_errors(head, shown, n=30_000, seed=1000).mean()
    assert found == pytest.approx(291, rel=0.03)  # the posterior median, see docs/guides/report.md


def depth_errors(head: ChartHead, shown: FocalLengthInput, n: int, seed: int) -> torch.Tensor:
    """Errors (m) of an estimate from f and z/(f size), which images of the data set `scale` determine at best."""
    z, size = uniform(n, *Z_RANGE, 3 * seed), uniform(n, 0.8, 1.2, 3 * seed + 1)
    f = uniform(n, *F_RANGE, 3 * seed + 2)
    seems = (z / (size * f * DEPTH.mu_z0)).log() / DEPTH.D
    raw = torch.stack([torch.zeros(n), torch.zeros(n), seems], dim=-1)
    return (head(shown(raw, f), Camera(f, 224.0)).mode[:, 2] - z).abs()


def test_of_the_whole_network_the_numbers_depend_on_f_where_it_is_shown() -> None:
    torch.manual_seed(0)
    image = torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8)
    networks = [Regressor(resnet(10), DistributionHead(DEPTH), shown) for shown in (None, FocalLengthInput(7, DEPTH))]
    for network, depends in zip(networks, (False, True), strict=True):
        if network.shown is not None:
            torch.nn.init.normal_(network.shown.last.weight)
        with torch.autocast("cpu", torch.bfloat16):
            wide, tele = (network.raw(image, torch.full((2,), f)) for f in F_RANGE)
        assert wide.dtype == torch.float32
        assert bool((wide != tele).any()) is depends
