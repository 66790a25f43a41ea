"""The backbone that keeps where things are, and heads that take what it says."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from phd_exp.config.targets import build
from phd_exp.geometry import Camera, DepthScale, LogDepth, Projected
from phd_exp.geometry.camera import middles
from phd_exp.geometry.charts import projected
from phd_exp.models.heads import ChartHead, DistributionHead, Head
from phd_exp.models.locating import Locating, LocatingNetwork, _of_segment
from phd_exp.models.regressor import Regressor
from tests.support.heads import SHAPED

DEPTH = DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0))
CAMERA = Camera(torch.tensor([1200.0, 1500.0, 1800.0, 2000.0]), 224.0)
PLACED: dict[str, Head] = {
    "probabilistic": DistributionHead(DEPTH),
    "mae_vz": ChartHead(DEPTH, Projected),
    "mae_logz": ChartHead(DEPTH, LogDepth),
    **SHAPED,
}


@pytest.fixture
def images() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (4, 64, 64, 3), generator=generator, dtype=torch.uint8)


def locating(depth: int = 10, segments: bool = False, points: int = 0) -> Locating:
    torch.manual_seed(0)
    return Locating(depth, width=8, stride=2, channels=6, segments=segments, points=points)


@pytest.mark.parametrize("depth", [10, 18, 50])
def test_it_sees_the_middle_before_it_has_learned(depth: int) -> None:
    seen = locating(depth)(torch.randn(2, 3, 64, 96))
    assert seen.features.shape == (2, 6 + 64 * (4 if depth == 50 else 1))
    # a quarter of the image's resolution: the second of the stages, of which the first has half
    assert seen.log_heat.shape == (2, 16, 24)
    assert_close(seen.log_heat.exp().sum((1, 2)), torch.ones(2))
    assert_close(seen.place, torch.zeros(2, 2), atol=1e-6, rtol=0)


def test_the_place_is_the_mean_of_the_map_and_its_offsets() -> None:
    network = locating()
    torch.nn.init.normal_(network.map.weight)
    offset = torch.tensor([0.2, -0.1])
    with torch.no_grad():
        network.map.weight[1:] = 0
        network.map.bias[1:] = offset
    seen = network(torch.randn(3, 3, 64, 64))
    assert seen.place.std() > 1e-4
    assert_close(
        seen.place, torch.einsum("bij,cij->bc", seen.log_heat.exp(), middles(16, 16).movedim(-1, 0)) + offset
    )


@pytest.mark.parametrize("preset", ["paper", "small"])
def test_the_recipe_costs_no_more_than_the_authors_network(preset: str, composed: Callable) -> None:
    from torch.utils.flop_counter import FlopCounterMode

    def operations(recipe: str) -> int:
        config = composed(f"preset={preset}", f"recipe={recipe}")
        network, side = build(config["backbone"]), config["data"]["image_size"]
        with FlopCounterMode(display=False) as counter:
            network(torch.zeros(1, 3, side, side))
        return counter.get_total_flops()

    assert operations("strong") < 1.3 * operations("paper")


@pytest.mark.parametrize("stretch", [1.0, 2.0])
def test_the_shape_of_an_ellipse(stretch: float) -> None:
    cells, centre, radius = middles(200, 200).flatten(0, 1).T, torch.tensor([[0.2], [-0.1]]), 0.2
    x, y = (cells - centre).double() / radius
    inside = ((x / stretch).square() + y.square() < 1).float()[None]
    mean, area, found, covariance = _of_segment(inside, cells[None] + 1, cells)
    assert_close(area.exp().item(), math.pi * radius**2 * stretch, rtol=0.01, atol=0)
    assert_close(found, centre.T, rtol=0, atol=1e-3)
    assert_close(mean, centre.T + 1, rtol=0, atol=1e-3)
    assert_close(covariance, torch.tensor([[stretch, 0, 1 / stretch]]), rtol=0, atol=0.02)


def test_points_add_their_places_relative_to_the_objects_and_their_variances() -> None:
    network = locating(points=2)
    torch.nn.init.normal_(network.map.weight)
    with torch.no_grad():
        network.points.weight.zero_()  # uniform maps: both points lie in the middle of the image
        seen = network(torch.randn(3, 3, 64, 64))
    places, variances = seen.features[:, -6:].split([4, 2], dim=1)
    assert_close(places, -seen.place.repeat(1, 2), atol=1e-6, rtol=0)
    assert_close(variances.exp(), torch.full((3, 2), 2 * (1 - 1 / 16**2) / 3))
    assert seen.features.shape == (3, network.n_features)


class Maps(nn.Module):
    """Feature maps of strides 4 and 8, as a list or by name."""

    def __init__(self, names: tuple[str, ...] = ()) -> None:
        super().__init__()
        self.names = names
        self.layers = nn.ModuleList(nn.Conv2d(n, m, 3, s, padding=1) for n, m, s in ((3, 5, 4), (5, 7, 2)))

    def forward(self, pixels: torch.Tensor) -> list[torch.Tensor] | dict[str, torch.Tensor]:
        fine = self.layers[0](pixels)
        maps = [fine, self.layers[1](fine.relu())]
        return dict(zip(self.names, maps, strict=True)) if self.names else maps


class Backwards(Maps):
    def forward(self, pixels: torch.Tensor) -> list[torch.Tensor]:
        return super().forward(pixels)[::-1]


@pytest.mark.parametrize("names", [(), ("fine", "coarse")])
def test_any_network_with_feature_maps_locates(names: tuple[str, ...], tmp_path: Path) -> None:
    trained = Maps()
    torch.save(trained.state_dict(), tmp_path / "maps.pth")
    network = LocatingNetwork(Maps(names), channels=6, side=64, points=2, pretrained=str(tmp_path / "maps.pth"))
    assert_close(network.network.state_dict(), trained.state_dict())
    seen = network(torch.randn(2, 3, 64, 96))
    assert seen.features.shape == (2, network.n_features) == (2, 6 + 7 + 6 + 6 + 3 * 2)
    assert (seen.log_heat.shape, seen.log_odds.shape) == ((2, 16, 24), (2, 16, 24))
    assert_close(seen.place, torch.zeros(2, 2), atol=1e-6, rtol=0)


@pytest.mark.parametrize("network", [nn.Conv2d(3, 4, 3), nn.Flatten(), Backwards()], ids=lambda n: type(n).__name__)
def test_a_network_without_feature_maps_is_refused(network: nn.Module) -> None:
    with pytest.raises(ValueError, match=r"for 2 images of 64 px; expected feature maps .* each coarser than"):
        LocatingNetwork(network, channels=6, side=64)


def test_what_it_reads_is_float32_under_autocast() -> None:
    with torch.autocast("cpu", torch.bfloat16):
        seen = locating(segments=True, points=3)(torch.randn(1, 3, 64, 64))
    assert {part.dtype for part in seen} == {torch.float32}


@pytest.mark.parametrize("name", PLACED)
def test_a_placed_prediction_lies_there(name: str) -> None:
    """What is zero stays at any precision of the density in the middle; placed, it is in the place."""
    head = PLACED[name]
    raw = torch.randn(4, head.n_outputs, generator=torch.Generator().manual_seed(1))
    raw[:, : 27 if name == "gaussian_mixture" else 2] = 0  # of a mixture, all Gaussians
    place = torch.tensor([[0.0, 0.0], [0.9, -0.3], [-1.0, 1.0], [0.2, 0.5]])
    mode = head(head.placed(raw, place), CAMERA).mode
    assert_close(projected(mode, CAMERA), place, atol=1e-5, rtol=0)
    assert_close(mode[:, 2], head(raw, CAMERA).mode[:, 2])


def test_a_nearly_singular_precision_does_not_move_the_centre_far_away() -> None:
    """Once, a network for `occl` had these numbers, and the object 66 km away."""
    head, place = PLACED["probabilistic"], torch.tensor([0.2, -0.5])
    placed = head.placed(torch.tensor([3.5, -0.4, 35.1, 10.9, -8.7, -1.2, 3.0]), place)
    away = projected(head(placed, CAMERA).mode, CAMERA) - place
    assert torch.linalg.vector_norm(away, dim=-1).max() < 3  # half sides of the image


@pytest.mark.parametrize("name", PLACED)
def test_the_network_predicts_where_it_sees_the_object(name: str, images: torch.Tensor) -> None:
    network = Regressor(locating(), PLACED[name])
    torch.nn.init.normal_(network.backbone.map.weight)
    seen = network.see(images)
    assert seen.place.std() > 1e-4
    assert_close(projected(network(images, CAMERA).mode, CAMERA), seen.place, atol=1e-5, rtol=0)
