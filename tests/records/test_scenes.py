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
    assert "\n" not in line
    assert SampleRecord.model_validate_json(line) == record
    assert SampleRecord.model_validate_json(line).model_dump_json() == line


def test_the_image_comes_first(record: SampleRecord) -> None:
    assert list(record.model_dump())[:5] == ["file_name", "x", "y", "z", "f"]


def test_position_is_that_of_the_cylinder(record: SampleRecord) -> None:
    cylinder = record.shown.objects[0]
    assert cylinder.shape == "cylinder"
    assert (record.x, record.y, record.z, record.scale) == (*cylinder.position, cylinder.scale)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("z", -1.0),
        ("f", 0.0),
        ("x", float("nan")),
        ("visibility", 1.5),
        ("truncation", -0.1),
        ("view", -1),
        ("pose", {"rotation": (2.0, 0.0, 0.0, 0.0), "translation": (0.0, 0.0, 0.0)}),
        ("split", "validation"),
        ("sha256", "0"),
        ("objects", []),
        ("objects", [{"shape": "teapot"}]),
        ("surplus", 1),
    ],
)
def test_what_is_no_record_is_refused(record: SampleRecord, key: str, value: Any) -> None:
    with pytest.raises(ValidationError, match=key):
        SampleRecord.model_validate(record.model_dump() | {key: value})


def test_a_scene_is_one_cylinder_and_at_most_one_of_each_other_shape(record: SampleRecord) -> None:
    fields = record.model_dump()
    (cylinder,) = fields["objects"]
    for objects in ([cylinder, cylinder], [cylinder | {"shape": "cube"}]):
        with pytest.raises(ValidationError, match="a cylinder first, then other shapes, each once"):
            SampleRecord.model_validate(fields | {"objects": objects})


def test_a_rotation_has_norm_one(record: SampleRecord) -> None:
    fields = record.model_dump()
    fields["objects"][0]["rotation"] = (1.0, 1.0, 0.0, 0.0)
    with pytest.raises(ValidationError, match="unit quaternion"):
        SampleRecord.model_validate(fields)
