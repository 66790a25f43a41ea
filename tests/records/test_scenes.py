"""A record survives the disk bit by bit, and refuses what is not a scene."""

from typing import Any

import pytest
from pydantic import ValidationError

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.scenes import SampleRecord


@pytest.fixture
def record(dataset: DatasetFolder) -> SampleRecord:
    return dataset.records("train")[0]


def test_a_record_survives_the_disk_to_the_last_bit(record: SampleRecord) -> None:
    line = record.model_dump_json()
    assert line.startswith('{"file_name":')
    assert "\n" not in line
    assert SampleRecord.model_validate_json(line) == record
    assert SampleRecord.model_validate_json(line).model_dump_json() == line


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("z", -1.0),
        ("x", float("nan")),
        ("visibility", 1.5),
        ("pose", {"rotation": (2.0, 0.0, 0.0, 0.0), "translation": (0.0, 0.0, 0.0)}),
        ("sha256", "0"),
        ("objects", []),
        ("objects", [{"shape": "teapot"}]),
        ("surplus", 1),
    ],
)
def test_what_is_no_record_is_refused(record: SampleRecord, key: str, value: Any) -> None:
    with pytest.raises(ValidationError, match=key):
        SampleRecord.model_validate(record.model_dump() | {key: value})


def test_a_scene_is_one_cylinder_or_several_equal_meshes_and_at_most_one_of_each_other_shape(
    record: SampleRecord,
) -> None:
    fields = record.model_dump()
    (cylinder,) = fields["objects"]
    mesh, other = cylinder | {"shape": "mesh"}, cylinder | {"shape": "mesh1"}
    assert len(SampleRecord.model_validate(fields | {"objects": [mesh, other, mesh]}).objects) == 3
    for objects in (
        [cylinder, cylinder],
        [cylinder | {"shape": "cube"}],
        [cylinder, mesh, mesh],
        [mesh, other, other],
    ):
        with pytest.raises(ValidationError, match="a cylinder or mesh first, then other shapes, each once"):
            SampleRecord.model_validate(fields | {"objects": objects})
    with pytest.raises(ValidationError, match="unit quaternion"):
        SampleRecord.model_validate(fields | {"objects": [cylinder | {"rotation": (1.0, 1.0, 0.0, 0.0)}]})
