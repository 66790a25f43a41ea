"""Training samples before other backdrops: the objects stay, what is behind them changes."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import torch

from phd_exp.data.backdrops import BACKDROP_NUMBERS, FINEST, Backdrops, before_others, tiled
from phd_exp.data.batches import Augment, Batch, Exchange
from phd_exp.data.datamodule import PositionData
from phd_exp.data.sources import RenderedSource
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import ConfigError
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.render import ensure_rendered
from tests.support.meshes import solid, write_mesh

SIDE, N = 32, 40


@pytest.fixture(scope="module")
def source(make_spec: Callable[..., DatasetSpec], tmp_path_factory: pytest.TempPathFactory) -> RenderedSource:
    """Two rendered samples of a mesh under skies, with a distractor, and what is behind them."""
    root = tmp_path_factory.mktemp("backdrops")
    mesh = write_mesh(root / "part.stl", solid("cylinder"))
    spec = make_spec(
        "object", mesh=str(mesh), backdrops="hdri", distractors=1, sensor_size=64, f_range=(343.0, 571.0)
    )
    for one in (spec, spec.without_objects):
        ensure_rendered(DatasetFolder(root / one.variant), one, n_train=2, n_test=0, workers=1)
    return RenderedSource(DatasetFolder(root / "object"), spec, {"train": 2, "held_out": 0, "test": 0}, SIDE)


@pytest.fixture
def batch() -> Batch:
    torch.manual_seed(0)
    image = torch.randint(0, 256, (N, SIDE, SIDE, 3), dtype=torch.uint8)
    return Batch(image, torch.rand(N, 3), torch.rand(N), float(SIDE), torch.randperm(N))


def numbers(columns: int) -> torch.Tensor:
    return 2 * torch.rand(N, columns, generator=torch.Generator().manual_seed(1)) - 1


def exchange(backdrops: Backdrops, share: float, then: Augment | None = None) -> Exchange:
    return Exchange(backdrops, before_others, BACKDROP_NUMBERS, share, then)


def test_renders_without_objects_are_the_renders_where_no_object_is(source: RenderedSource) -> None:
    images, found = source.samples("train").image.int(), source.training_backdrops()
    nothing, object_alone = found.clear == 255, found.clear == 0
    difference = (found.empty.int() - images).abs().amax(-1)
    assert nothing.float().mean() > 0.3
    assert difference[nothing].float().quantile(0.95) < 12  # the denoiser works on a neighbourhood
    assert difference[object_alone].float().median() > 12


def test_an_object_appears_before_the_other_backdrop(source: RenderedSource) -> None:
    found, samples = source.training_backdrops(), source.samples("train")
    draw = torch.tensor([[-1.0, 0.5, 0.5, -1, -1, -1, 1], [-1.0, -0.5, -0.5, -1, 0, -1, -1]])
    new = exchange(found, 0.5)(samples, draw)
    for row, other in ((0, found.empty[1]), (1, found.empty[0].flip(0).transpose(0, 1))):
        nothing, object_alone = found.clear[row] == 255, found.clear[row] == 0
        assert torch.equal(new.image[row][object_alone], samples.image[row][object_alone])
        change = new.image[row][nothing].int() - other[nothing].int()
        rest = samples.image[row][nothing].int() - found.empty[row][nothing].int()
        inside = (new.image[row][nothing] > 0) & (new.image[row][nothing] < 255)
        assert torch.equal(change[inside], rest[inside])
    assert torch.equal(new.xyz, samples.xyz)


def test_the_backdrop_with_more_texture_is_preferred(batch: Batch) -> None:
    empty = torch.zeros_like(batch.image)
    empty[::2] = batch.image[::2]
    clear = torch.full((N, SIDE, SIDE), 255, dtype=torch.uint8)
    black = replace(batch, image=empty[batch.row])
    new = exchange(Backdrops(empty, clear), 1.0)(black, numbers(BACKDROP_NUMBERS))
    assert (new.image != 0).any((1, 2, 3)).float().mean() == pytest.approx(0.75, abs=0.15)


def tile(image: torch.Tensor, fine: float, down: float, right: float, turn: float = 0.9) -> torch.Tensor:
    """One view, given how many times smaller it shows the image."""
    images = torch.stack([torch.zeros_like(image), image])
    return tiled(images, np.array([1]), np.array([[math.log(fine) / math.log(FINEST), down, right, turn]]))[0]


def test_an_image_and_its_mirror_images_tile_the_plane() -> None:
    image = torch.randint(0, 256, (SIDE, SIDE, 3), dtype=torch.uint8)
    assert torch.equal(tile(image, 1.0, 0.0, 0.0), image)
    assert torch.equal(tile(image, 1.0, 0.5, 0.0), image.flip(0))
    assert torch.equal(tile(image, 1.0, 0.0, 0.5), image.flip(1))
    half = image[::2, ::2]
    small = tile(image, 2.0, 0.0, 0.0)
    assert torch.equal(small[: SIDE // 2, : SIDE // 2], half)
    assert torch.equal(small[SIDE // 2 :, : SIDE // 2], image[1::2, ::2].flip(0))
    fine = tile(image, FINEST, 0.37, 0.81)
    assert {tuple(pixel) for pixel in fine.view(-1, 3).tolist()} <= {tuple(p) for p in image.view(-1, 3).tolist()}
    assert torch.equal(tile(image, FINEST, 0.37, 0.81, turn=0.1), fine.transpose(0, 1))


def test_training_batches_alone_get_other_backdrops_and_prints(source: RenderedSource) -> None:
    shares = ({}, {"backdrops": 1.0}, {"prints": 1.0}, {"backdrops": 1.0, "prints": 1.0})
    first, *others = (PositionData(source, batch_size=2, **share) for share in shares)
    for data in (first, *others):
        data.setup()
    batches = [batch for data in (first, *others) for batch in data.train_dataloader()]
    assert all(torch.equal(batches[0].row, batch.row) for batch in batches)
    assert not any(torch.equal(one.image, other.image) for one, other in combinations(batches, 2))
    assert all(torch.equal(first.samples["train"].image, data.samples["train"].image) for data in others)


@pytest.mark.parametrize("key", ["backdrops", "prints"])
def test_images_of_unknown_backdrops_are_refused(
    make_spec: Callable[..., DatasetSpec], tmp_path: Path, key: str
) -> None:
    sizes = {"train": 2, "held_out": 0, "test": 0}
    cylinder = RenderedSource(DatasetFolder(tmp_path), make_spec("default"), sizes, SIDE)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=rf"recipe.augmentation.{key}: got 0.5.*expected 0, or data=object"):
        PositionData(cylinder, batch_size=2, **{key: 0.5})
