"""Photographs among training renders: their labels, their share, their masks, and what is refused."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from phd_exp.data.batches import Batch, Exchange
from phd_exp.data.datamodule import PositionData
from phd_exp.data.photographs import PHOTOGRAPH_NUMBERS, Photographs, replaced
from phd_exp.data.sources import RenderedSource
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import DatasetError
from phd_exp.records.spec import DatasetSpec
from tests.support.handmade import SIDE

N = 200


@pytest.fixture
def source(folder: DatasetFolder, spec: DatasetSpec) -> RenderedSource:
    return RenderedSource(folder, spec, {"train": 5, "held_out": 0, "test": 3}, SIDE)


@pytest.fixture
def photos(folder: DatasetFolder, tmp_path: Path) -> Path:
    """Three labelled images without splits: a rendered split is such a folder too."""
    return Path(shutil.copytree(folder.root / "test", tmp_path / "photos"))


def batch_of(n: int, value: int) -> Batch:
    number = value + torch.arange(n, dtype=torch.uint8)
    image = number[:, None, None, None].repeat(1, 8, 8, 3)
    return Batch(image, torch.rand(n, 3), torch.rand(n), 8.0, torch.arange(n))


def test_photographs_replace_their_share_with_labels_and_weigh_no_mask() -> None:
    class Inspect:
        n_numbers = 4

        def __call__(self, batch: Batch, given: torch.Tensor) -> Batch:
            assert torch.equal(given, draw[:, :4])
            return batch

    renders, photographs = batch_of(N, 0), batch_of(7, 249)
    renders = replace(renders, mask=torch.zeros(N, 2, 2, dtype=torch.uint8))
    draw = 2 * torch.rand(N, 4 + PHOTOGRAPH_NUMBERS, generator=torch.Generator().manual_seed(0)) - 1
    exchange = Exchange(photographs, replaced, PHOTOGRAPH_NUMBERS, 0.3, Inspect())
    assert exchange.n_numbers == 4 + PHOTOGRAPH_NUMBERS
    mixed = exchange(renders, draw)
    is_photograph = mixed.mask_weight == 0
    assert torch.equal(mixed.mask_weight == 1, ~is_photograph)
    assert is_photograph.float().mean() == pytest.approx(0.3, abs=0.1)
    which = (mixed.image[is_photograph, 0, 0, 0] - 249).long()
    assert which.unique().tolist() == list(range(7))
    for name in ("image", "xyz", "f"):
        new = getattr(mixed, name)
        assert torch.equal(new[is_photograph], getattr(photographs, name)[which])
        assert torch.equal(new[~is_photograph], getattr(renders, name)[~is_photograph])
    assert exchange(replace(renders, mask=None), draw).mask_weight is None


def test_training_batches_alone_have_photographs(source: RenderedSource, photos: Path) -> None:
    mixed = Photographs(photos, None, SIDE, 0.99)
    data = PositionData(source, batch_size=5, masks=True, photographs=mixed)
    data.setup()
    data.move_to(torch.device("cpu"))
    (batch,), found = data.train_dataloader(), mixed.samples(source.samples("train"))
    of_photographs = {tuple(one.flatten().tolist()) for one in found.image}
    assert {tuple(one.flatten().tolist()) for one in batch.image} <= of_photographs
    assert batch.mask_weight.sum() == 0
    (tested,) = data.test_dataloader()
    assert torch.equal(tested.image, source.samples("test").image)
    assert tested.mask_weight is None


@pytest.mark.parametrize("change", [{"z": 90.0, "x": 0.0, "y": 0.0}, {"box": [30, 30, 34, 34], "x": 0.0, "y": 0.0}])
def test_labels_that_do_not_fit_the_renders_are_refused(source: RenderedSource, photos: Path, change: dict) -> None:
    """Positions far beyond those of the renders, and boxes that are far smaller than the object."""
    file = photos / "metadata.jsonl"
    lines = [json.loads(line) | change for line in file.read_text().splitlines()]
    file.write_text("".join(json.dumps(line) + "\n" for line in lines))
    data = PositionData(source, batch_size=5, photographs=Photographs(photos, None, SIDE, 0.5))
    with pytest.raises(DatasetError, match=r"^data\.photographs\.folder: got .*; expected .* in metres") as error:
        data.setup()
    assert "\n" not in str(error.value)
