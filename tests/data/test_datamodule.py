"""A rendered data set as batches: the camera shrinks with the image, the depth scale grows; masks."""

import math
from typing import Any

import pytest
import torch

from phd_exp.data.batches import Batch
from phd_exp.data.datamodule import PositionData, held_on
from phd_exp.data.sources import Part, RenderedSource
from phd_exp.records.dataset import CELLS, DatasetFolder
from phd_exp.records.errors import DatasetError
from phd_exp.records.spec import DatasetSpec
from tests.support.handmade import SIDE


def data(
    folder: DatasetFolder, spec: DatasetSpec, image_size: int = 64, n_train: int = 5, n_held_out: int = 0
) -> PositionData:
    sizes: dict[Part, int] = {"train": n_train, "held_out": n_held_out, "test": 3}
    source = RenderedSource(folder, spec, sizes, image_size)
    module = PositionData(source, batch_size=2, seed=0)
    module.setup()
    return module


def test_batches_are_those_of_the_records(folder: DatasetFolder, spec: DatasetSpec) -> None:
    module = data(folder, spec)
    assert [len(batch) for batch in module.train_dataloader()] == [2, 2]
    (first, second) = list(module.test_dataloader())
    records = folder.records("test")
    assert [len(first), len(second)] == [2, 1]
    xyz = torch.tensor([(record.x, record.y, record.z) for record in records])
    assert torch.equal(torch.cat([first.xyz, second.xyz]), xyz)
    assert torch.cat([first.f, second.f]).tolist() == [record.f for record in records]
    assert first.S == 64.0


@pytest.mark.parametrize("image_size", [64, 32])
def test_normalised_truth_does_not_depend_on_image_size(
    folder: DatasetFolder, spec: DatasetSpec, image_size: int
) -> None:
    from phd_exp.geometry import compensated_depth, projected

    module = data(folder, spec, image_size)
    batch = module.samples["train"]
    assert batch.image.shape == (5, image_size, image_size, 3)
    assert image_size == batch.S
    whole = data(folder, spec)
    reference = whole.samples["train"]
    torch.testing.assert_close(projected(batch.xyz, batch.camera), projected(reference.xyz, reference.camera))
    torch.testing.assert_close(
        compensated_depth(batch.xyz, batch.camera, module.source.depth.mu_z0),
        compensated_depth(reference.xyz, reference.camera, whole.source.depth.mu_z0),
    )
    assert module.source.constant_f == pytest.approx(math.sqrt(400 * 600) * image_size / 64)


def test_held_out_samples_follow_those_trained_on(folder: DatasetFolder, spec: DatasetSpec) -> None:
    module = data(folder, spec, n_train=3, n_held_out=2)
    whole = data(folder, spec)
    assert "held_out" not in whole.samples
    assert [len(module.samples[part]) for part in ("train", "held_out", "test")] == [3, 2, 3]  # type: ignore[index]
    assert torch.equal(module.samples["train"].image, whole.samples["train"].image[:3])
    assert torch.equal(module.samples["held_out"].image, whole.samples["train"].image[3:])
    assert torch.equal(module.samples["held_out"].xyz, whole.samples["train"].xyz[3:])
    assert module.source.known("held_out")["file_name"] == whole.source.known("train")["file_name"][3:]
    (batch,) = module.in_order("held_out")
    assert batch.row.tolist() == [0, 1]


def test_callbacks_see_the_held_out_samples_that_choose(folder: DatasetFolder, spec: DatasetSpec) -> None:
    source = RenderedSource(folder, spec, {"train": 2, "held_out": 3, "test": 3}, 64)
    module = PositionData(source, batch_size=2, seed=0, held_out=True)
    module.setup()
    rows = [[batch.row.tolist() for batch in loader] for loader in module.val_dataloader()]
    assert rows == [[[0, 1], [2]], [[0, 2]]]


@pytest.mark.parametrize("share", [0.9, 2.1])
def test_samples_without_room_on_a_gpu_stay_on_the_host(
    folder: DatasetFolder, spec: DatasetSpec, share: float, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    samples = data(folder, spec).samples["train"]
    there = samples.select(slice(1))
    monkeypatch.setattr(Batch, "to", lambda *_: there)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (int(share * samples.n_bytes), 0))
    found = held_on(torch.device("cuda:0"), samples, "the train samples")
    assert found is (there if share > 2 else samples)
    line = "cuda:0: the train samples take 0.0 GB, more than the 0.0 GB there; they stay in host memory\n"
    assert capsys.readouterr().err.replace("\n", " ").strip() == ("" if share > 2 else line.strip())


def test_samples_on_the_host_serve_another_device(folder: DatasetFolder, spec: DatasetSpec) -> None:
    module = data(folder, spec)
    module.move_to(torch.device("meta"))  # has no memory
    assert module.samples["train"].image.device.type == "cpu"
    for loader in (module.train_dataloader(), *module.val_dataloader()):
        assert {batch.image.device.type for batch in loader} == {"meta"}


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
