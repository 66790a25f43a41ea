"""A specification refuses invalid values; its shards are a partition."""

import hashlib
import json
import math
from collections.abc import Callable
from typing import Any

import pytest
from pydantic import ValidationError

from phd_exp.records.assets import Asset
from phd_exp.records.cameras import calibration
from phd_exp.records.spec import DatasetSpec, Shard
from tests.support.renders import VARIANTS

MakeSpec = Callable[..., DatasetSpec]
YOUNGER = {key for key, field in DatasetSpec.model_fields.items() if not field.is_required()}
CAMERA = calibration({"f": 900.0, "width": 640, "height": 480})
MESH = Asset(files={"part.glb": "0" * 64})


BAD: dict[str, list[Any]] = {
    "variant": ["../elsewhere", ""],
    "seed": [-1, 1.0, True],
    "sensor_size": [0, 224.0, "224"],
    "f_range": [(2000.0, 1200.0), (0.0, 1200.0), (-1.0, 1200.0), (1200.0,), 1200.0, ("1", "2"), (1200.0, math.inf)],
    "z_range": [(0.0, 5.0), (3.0, math.nan)],
    "xy_range": [1.1, -0.1],
    "edge_distance": [-1.1, 2.1],
    "scale_range": [(0.0, 1.0), (1.0, 3.0)],
    "occluders": [1, "yes"],
    "lamp_jitter": [1.0],
    "samples_per_pixel": [0, 2.5],
    "views": [0],
    "view_angle_range": [(20.0, 120.0), (60.0, 20.0)],
    "image_format": ["gif"],
    "image_quality": [0, 101],
    "saturation_range": [(0.5, 0.4), (0.0, 1.1)],
    "half_hidden": [1],
    "frames": [0, 2.0],
    "frame_rate": [0.0],
    "speed": [-1.0],
    "spin_range": [(90.0, 0.0)],
    "camera_speed": [math.inf],
    "camera_turn": [91.0],
    "sensor": [224],
}  # fmt: skip


@pytest.mark.parametrize(("key", "value"), [(key, value) for key, values in BAD.items() for value in values])
def test_an_invalid_value_is_refused_and_its_key_named(make_spec: MakeSpec, key: str, value: Any) -> None:
    with pytest.raises(ValidationError) as error:
        make_spec(**{key: value})
    assert [complaint["loc"][0] for complaint in error.value.errors()] == [key] * error.value.error_count()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"frames": 2, "mesh": MESH}, "frames: got 2; sequences are of the cylinder; expected 1"),
        ({"speed": 1.0}, "speed: nothing moves in single images; expected data=sequence"),
    ],
)
def test_a_motion_without_a_sequence_is_refused(make_spec: MakeSpec, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        make_spec(**values)


def test_every_value_has_to_be_given(make_spec: MakeSpec) -> None:
    for key in DatasetSpec.model_fields.keys() - YOUNGER:
        with pytest.raises(ValidationError, match=key):
            DatasetSpec(**{name: value for name, value in make_spec() if name != key})


def test_a_fingerprint_depends_on_every_value_and_on_nothing_else(make_spec: MakeSpec) -> None:
    changes = {
        "variant": "other",
        "seed": 1,
        "sensor_size": 112,
        "f_range": (1200.0, 1999.0),
        "z_range": (3.0, 4.9),
        "xy_range": 0.5,
        "scale_range": (0.8, 1.2),
        "occluders": True,
        "lamp_jitter": 0.1,
        "samples_per_pixel": 8,
        "views": 2,
        "view_angle_range": (20.0, 60.0),
        "image_format": "webp",
        "image_quality": 90,
        "saturation_range": (0.0, 0.1),
        "half_hidden": True,
        "frames": 2,
        "mesh": Asset(files={"part.glb": "1" * 64}),
    }
    of_sequences = {
        "frame_rate": 25.0,
        "speed": 1.0,
        "spin_range": (0.0, 0.0),
        "camera_speed": 0.1,
        "camera_turn": 1.0,
    }
    of_meshes = {
        "unit": 0.001,
        "reference": "centroid",
        "upright": True,
        "pitch_range": (10.0, 20.0),
        "backdrops": "hdri",
        "ground": True,
        "distractors": 1,
        "distractor_meshes": (MESH,),
        "motion_blur": 2.0,
        "ignore": ("materials",),
        "empty": True,
        "camera": CAMERA,
        "view": "field",
        "box_size": (1.0, 1.2),
        "box_shift": 0.1,
        "edge_distance": 0.0,
        "grey": True,
        "looks": "varied",
        "front": (0.0, 0.0, 1.0),
        "front_range": (0.0, 60.0),
        "resting": True,
        "copies": 2,
    }
    needed = {"ground": {"upright": True, "pitch_range": (20.0, 30.0)}, "front_range": {"front": (0.0, 0.0, 1.0)}}
    needed |= {key: {"camera": CAMERA} for key in ("view", "box_size", "box_shift", "edge_distance")}
    assert changes.keys() | of_sequences.keys() | of_meshes.keys() == DatasetSpec.model_fields.keys()
    prints = {make_spec(**{key: value}).fingerprint() for key, value in changes.items()}
    prints |= {make_spec(frames=2, **{key: value}).fingerprint() for key, value in of_sequences.items()}
    for key, value in of_meshes.items():
        prints.add(make_spec(mesh=MESH, f_range=None, **{key: value}, **needed.get(key, {})).fingerprint())
    prints |= {make_spec().fingerprint(), make_spec(f_range=[1200, 2000]).fingerprint()}
    assert len(prints) == len(changes) + len(of_sequences) + len(of_meshes) + 1
    assert make_spec().fingerprint() == "1933c9582b94b54b", "the same on every machine, for ever"


@pytest.mark.parametrize("variant", VARIANTS)
def test_younger_keys_leave_the_first_data_sets_as_they_were(make_spec: MakeSpec, variant: str) -> None:
    spec = make_spec(variant)
    older = {key: value for key, value in vars(spec).items() if key not in YOUNGER}
    canonical = json.dumps(older, sort_keys=True, separators=(",", ":"))
    assert spec.fingerprint() == hashlib.sha256(canonical.encode()).hexdigest()[:16]
    assert spec.model_dump() == older
    assert list(json.loads(spec.model_dump_json())) == list(older), "in the order of older manifests"
    assert DatasetSpec(**older) == spec
    changed = make_spec(variant, half_hidden=True)
    assert DatasetSpec.model_validate_json(changed.model_dump_json()) == changed


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_shares_are_a_partition_of_equal_sizes(count: int) -> None:
    shards = [Shard.parse(f"{index}/{count}") for index in range(count)]
    sizes = [sum(shard.holds(index) for index in range(20)) for shard in shards]
    assert max(sizes) - min(sizes) <= 1
    for index in range(20):
        assert sum(shard.holds(index) for shard in shards) == 1


@pytest.mark.parametrize("text", ["4/4", "-1/2", "1/0", "0/0", "a", "1", "", "1/2/3", " 1/2", 1, 0.5, None])
def test_what_is_no_shard_is_refused(text: object) -> None:
    with pytest.raises(ValueError, match="expected INDEX/COUNT with 0 <= INDEX < COUNT"):
        Shard.parse(text)
