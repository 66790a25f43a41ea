"""A data set folder says what it holds, what it lacks, and what is wrong with it."""

import json
from collections.abc import Callable
from pathlib import Path

import pandas
import pytest
from PIL import Image

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import CorruptFileError, DatasetError
from phd_exp.records.spec import DatasetSpec
from tests.support.handmade import picture

MakeSpec = Callable[..., DatasetSpec]


def test_records_come_in_order(dataset: DatasetFolder) -> None:
    assert [record.index for record in dataset.records("train")] == [0, 1, 2, 3, 4]
    assert [record.index for record in dataset.records("test", 1)] == [0]
    assert dataset.records("test", 0) == []


def test_nothing_is_missing_from_what_is_there(dataset: DatasetFolder, make_spec: MakeSpec) -> None:
    assert dataset.missing(make_spec(), 5, 2) == {"train": [], "test": []}
    assert dataset.missing(make_spec(), 3, 0) == {"train": [], "test": []}


def test_the_rest_is_missing_when_more_is_asked_for(dataset: DatasetFolder, make_spec: MakeSpec) -> None:
    assert dataset.missing(make_spec(), 7, 3) == {"train": [5, 6], "test": [2]}


def test_all_is_missing_from_nothing(tmp_path: Path, make_spec: MakeSpec) -> None:
    assert DatasetFolder(tmp_path / "new").missing(make_spec(), 2, 1) == {"train": [0, 1], "test": [0]}


def test_what_is_deleted_is_missing(dataset: DatasetFolder, make_spec: MakeSpec) -> None:
    dataset.image_path("train", 3).unlink()
    assert dataset.missing(make_spec(), 5, 2)["train"] == [3]
    dataset.metadata_path("test").unlink()
    assert dataset.missing(make_spec(), 5, 2)["test"] == [0, 1]


def test_another_specification_is_refused(dataset: DatasetFolder, make_spec: MakeSpec) -> None:
    with pytest.raises(
        DatasetError, match=r"default: holds .* seed=0, but seed=1 is asked for; move .* or choose"
    ):
        dataset.missing(make_spec(seed=1, xy_range=0.5), 5, 2)


def test_too_many_samples_asked_for(dataset: DatasetFolder) -> None:
    with pytest.raises(DatasetError, match=r"train: 9 samples asked for, 5 found"):
        dataset.records("train", 9)


def test_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"no data set here .* render it first"):
        DatasetFolder(tmp_path).records("train")


@pytest.mark.parametrize("content", ["", "nonsense", "{}", '{"generator": 1}'])
def test_a_broken_manifest(dataset: DatasetFolder, make_spec: MakeSpec, content: str) -> None:
    dataset.manifest_path.write_text(content)
    with pytest.raises(DatasetError, match=r"manifest\.json: not a readable manifest") as error:
        dataset.missing(make_spec(), 5, 2)
    assert "\n" not in str(error.value)


def test_a_broken_line_is_named(dataset: DatasetFolder) -> None:
    path = dataset.metadata_path("train")
    lines = path.read_text().splitlines()
    lines[2] = lines[2].replace('"z":', '"Z":', 1)
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(CorruptFileError, match=r"metadata\.jsonl, line 3: .*") as error:
        dataset.records("train")
    assert "\n" not in str(error.value)
    assert len(dataset.records("train", 2)) == 2


def test_lost_or_shuffled_metadata(dataset: DatasetFolder) -> None:
    path = dataset.metadata_path("train")
    path.write_text("".join(reversed(path.read_text().splitlines(keepends=True))))
    with pytest.raises(DatasetError, match="samples 0 to 4 in order"):
        dataset.records("train")
    path.unlink()
    with pytest.raises(DatasetError, match="missing though the manifest counts 5"):
        dataset.records("train")


def test_pandas_and_pillow_read_it_as_it_is(dataset: DatasetFolder) -> None:
    folder = dataset.split_folder("train")
    table = pandas.read_json(folder / "metadata.jsonl", lines=True, precise_float=True)
    assert table.columns[0] == "file_name"
    assert table.z.tolist() == pytest.approx([record.z for record in dataset.records("train")], rel=1e-15)
    with Image.open(folder / table.file_name[4]) as image:
        assert image.getpixel((0, 0)) == tuple(picture(4)[0, 0])


def test_it_is_what_imagefolder_asks_for(dataset: DatasetFolder) -> None:
    """Every image of a split is named by one line, and no other file looks like an image or like metadata."""
    for split in ("train", "test"):
        lines = (dataset.split_folder(split) / "metadata.jsonl").read_text().splitlines()
        named = {json.loads(line)["file_name"] for line in lines}
        assert {path.name for path in dataset.split_folder(split).iterdir()} == named | {"metadata.jsonl"}
