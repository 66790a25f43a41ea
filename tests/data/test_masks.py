"""Masks of training samples: the visible part of the object in each cell, kept on disk, turned with the image."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from phd_exp.data.datamodule import PositionData
from phd_exp.data.images import CELLS, mask
from phd_exp.data.sources import RenderedSource
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rays import cylinder_mask, trace_pixels
from phd_exp.rendering.samples import describe
from phd_exp.rendering.sampling import sample_scene
from phd_exp.rendering.triangles import NO_MESHES
from tests.support.handmade import SIDE


@pytest.fixture
def source(folder: DatasetFolder, spec: DatasetSpec) -> RenderedSource:
    return RenderedSource(folder, spec, {"train": 3, "held_out": 2, "test": 3}, SIDE)


@pytest.mark.parametrize("variant", ["default", "occl_scale"])
def test_a_cell_is_the_share_of_its_pixels_that_show_the_object(
    variant: str, make_spec: Callable[..., DatasetSpec]
) -> None:
    spec = make_spec(variant, sensor_size=224)
    for index in range(20):
        scene = sample_scene(spec, "train", index)
        hits = trace_pixels(scene)
        found = mask(describe(spec, "train", index, scene, hits, "0" * 64, NO_MESHES), NO_MESHES) / 255
        share = cylinder_mask(hits).reshape(CELLS, 8, CELLS, 8).mean((1, 3))
        assert np.abs(found - share).max() < 0.2  # of 16 rays and 64 pixels
        assert found.sum() == pytest.approx(share.sum(), rel=0.05, abs=0.3)


def test_only_training_batches_have_masks_and_the_folder_keeps_them(source: RenderedSource) -> None:
    data = PositionData(source, batch_size=3, masks=True)
    data.setup()
    masks = data.samples["train"].mask
    assert masks is not None
    assert masks.shape == (3, CELLS, CELLS)
    assert masks.amax() == 255
    assert data.samples["held_out"].mask is None
    assert data.samples["test"].mask is None
    (batch,) = data.train_dataloader()
    assert torch.equal(batch.mask, masks[batch.row])
    (kept,) = source.folder.cache.glob("*-masks.npy")
    before = kept.stat().st_mtime_ns
    assert torch.equal(source.training_masks(), masks)
    assert kept.stat().st_mtime_ns == before


def test_without_the_loss_no_mask_is_drawn(source: RenderedSource) -> None:
    data = PositionData(source, batch_size=3)
    data.setup()
    assert data.samples["train"].mask is None
    assert not list(source.folder.cache.glob("*-masks*"))
