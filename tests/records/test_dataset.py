"""A data set folder says what it holds, what it lacks, and what is wrong with it."""

from collections.abc import Callable

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import DatasetError
from phd_exp.records.spec import DatasetSpec

MakeSpec = Callable[..., DatasetSpec]


def test_records_come_in_order(dataset: DatasetFolder) -> None:
    assert [record.index for record in dataset.records("train")] == [0, 1, 2, 3, 4]
    assert [record.index for record in dataset.records("test", 1)] == [0]
    assert dataset.records("test", 0) == []


@pytest.mark.parametrize(("wanted", "train", "test"), [((5, 2), [], []), ((3, 0), [], []), ((7, 3), [5, 6], [2])])
def test_samples_beyond_the_finished_ones_are_missing(
    dataset: DatasetFolder, make_spec: MakeSpec, wanted: tuple[int, int], train: list[int], test: list[int]
) -> None:
    assert dataset.missing(make_spec(), *wanted) == {"train": train, "test": test}
    new = DatasetFolder(dataset.root / "new").missing(make_spec(), *wanted)
    assert [len(indices) for indices in new.values()] == list(wanted)


def test_what_is_deleted_is_missing(dataset: DatasetFolder, make_spec: MakeSpec) -> None:
    dataset.image_path("train", 3).unlink()
    assert dataset.missing(make_spec(), 5, 2)["train"] == [3]
    dataset.metadata_path("test").unlink()
    assert dataset.missing(make_spec(), 5, 2)["test"] == [0, 1]


def test_lost_shuffled_and_missing_records_are_named(dataset: DatasetFolder) -> None:
    path = dataset.metadata_path("train")
    path.write_text("".join(reversed(path.read_text().splitlines(keepends=True))))
    with pytest.raises(DatasetError, match="samples 0 to 4 in order"):
        dataset.records("train")
    path.unlink()
    with pytest.raises(DatasetError, match="missing though the manifest counts 5"):
        dataset.records("train")
    with pytest.raises(DatasetError, match=r"train: 9 samples asked for, 5 found"):
        dataset.records("train", 9)
    with pytest.raises(DatasetError, match=r"no data set here .* render it first"):
        DatasetFolder(dataset.root / "new").records("train")
