"""Masks of training samples: read from the data set by training batches alone, and missed in one line."""

import pytest
import torch

from phd_exp.data.datamodule import PositionData
from phd_exp.data.sources import RenderedSource
from phd_exp.records.dataset import CELLS, DatasetFolder
from phd_exp.records.errors import DatasetError
from phd_exp.records.spec import DatasetSpec
from tests.support.handmade import SIDE


@pytest.fixture
def source(folder: DatasetFolder, spec: DatasetSpec) -> RenderedSource:
    return RenderedSource(folder, spec, {"train": 3, "held_out": 2, "test": 3}, SIDE)


def test_training_batches_alone_have_masks(source: RenderedSource) -> None:
    data = PositionData(source, batch_size=3, masks=True)
    data.setup()
    masks = data.samples["train"].mask
    assert masks.shape == (3, CELLS, CELLS)
    assert masks.amax() == 255
    assert data.samples["held_out"].mask is None
    assert data.samples["test"].mask is None
    (batch,) = data.train_dataloader()
    assert torch.equal(batch.mask, masks[batch.row])
    masks.zero_()
    assert source.training_masks().amax() == 255, "the file does not change"


def test_masks_that_are_missing_are_missed_by_their_loss_alone(source: RenderedSource) -> None:
    (source.folder.root / "masks.npy").unlink()
    data = PositionData(source, batch_size=3)
    data.setup()
    assert data.samples["train"].mask is None
    needy = PositionData(source, batch_size=3, masks=True)
    with pytest.raises(DatasetError, match=r"masks\.npy: .*No such file.* `python -m phd_exp render data=") as error:
        needy.setup()
    assert "\n" not in str(error.value)
