"""Sequences: smooth motions whose every frame has the distribution of single images, and whose first frame is one."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from phd_exp.records.scenes import SceneObject
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rays import in_camera_frame, rotation_matrix
from phd_exp.rendering.sampling import sample_scene
from tests.support.renders import UNLIKELY, MakeSpec, described

SEQUENCES, FRAMES = 150, 25
SHOWN = (0, 1, 7, FRAMES - 1)
MOVING_CAMERA = {"camera_speed": 0.3, "camera_turn": 8.0}


def in_camera(spec: DatasetSpec, index: int, which: int = 0) -> np.ndarray:
    scene = sample_scene(spec, "test", index)
    return in_camera_frame(np.array(scene.objects[which].position), scene.pose)


@pytest.fixture(scope="module")
def paths(make_spec: MakeSpec) -> np.ndarray:
    """Coordinates uniform on [-1, 1] of the sphere (sequences, frames shown, 3)."""
    spec = make_spec("sequence", occluders=True, frames=FRAMES, frame_rate=5.0)
    indices = [FRAMES * scene + frame for scene in range(SEQUENCES) for frame in SHOWN]
    found = np.array([in_camera(spec, index, which=2) for index in indices])
    f = np.array([sample_scene(spec, "test", FRAMES * scene).f for scene in range(SEQUENCES)]).repeat(len(SHOWN))
    across = found[:, :2] / found[:, 2:] * (2 * f / spec.sensor_size)[:, None]
    return np.column_stack([across, found[:, 2] - 4]).reshape(SEQUENCES, len(SHOWN), 3)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("frame", range(1, len(SHOWN)))
def test_every_frame_has_the_distribution_of_single_images(paths: np.ndarray, frame: int, axis: int) -> None:
    assert stats.kstest(paths[:, frame, axis], stats.uniform(-1, 2).cdf).pvalue > UNLIKELY


def test_a_long_path_leaves_where_it_began(paths: np.ndarray) -> None:
    """After five seconds, the place does not depend on the first one."""
    for axis in range(2):  # depth has a wider range and takes longer
        assert abs(np.corrcoef(paths[:, 0, axis], paths[:, -1, axis])[0, 1]) < 4 / SEQUENCES**0.5


def test_speeds_are_those_of_the_specification_and_paths_are_smooth(make_spec: MakeSpec) -> None:
    spec = make_spec("sequence", frames=3, frame_rate=100.0, speed=0.7)
    places = np.array([in_camera(spec, index) for index in range(3 * 400)]).reshape(400, 3, 3)
    velocity = np.diff(places, axis=1) * spec.frame_rate
    np.testing.assert_allclose(np.sqrt((velocity**2).mean((0, 1))), 0.7, rtol=0.12)
    assert np.abs(np.diff(velocity, axis=1)).max() < 0.5, "m/s in 10 ms; a jump is 1"
    still = make_spec("sequence", speed=0.0)
    np.testing.assert_allclose(in_camera(still, 19), in_camera(still, 0), atol=1e-9)


def test_objects_turn_about_one_axis_at_a_constant_rate(make_spec: MakeSpec) -> None:
    spec = make_spec("sequence", frames=3, frame_rate=10.0, spin_range=(30.0, 60.0))
    for scene in range(10):
        matrices = [rotation_matrix(sample_scene(spec, "train", 3 * scene + k).objects[0].rotation) for k in range(3)]
        first, second = (Rotation.from_matrix(matrices[k + 1] @ matrices[k].T).as_rotvec() for k in range(2))
        np.testing.assert_allclose(first, second, atol=1e-9)
        assert 3 <= np.degrees(np.linalg.norm(first)) <= 6


@pytest.mark.parametrize("variant", ["default", "occl", "scale"])
@pytest.mark.parametrize("half_hidden", [False, True])
def test_the_first_frame_is_the_single_image_and_the_others_show_the_same_things(
    make_spec: MakeSpec, variant: str, half_hidden: bool
) -> None:
    one = make_spec(variant, half_hidden=half_hidden)
    spec = make_spec(variant, half_hidden=half_hidden, frames=4, **MOVING_CAMERA)
    seeds = set()
    for scene in range(5):
        first, *others = (sample_scene(spec, "train", 4 * scene + frame) for frame in range(4))
        assert first == sample_scene(one, "train", scene)
        for other in others:
            assert (other.f, other.lamps, other.backdrop) == (first.f, first.lamps, first.backdrop)
            assert list(map(fixed, other.objects)) == list(map(fixed, first.objects))
            assert other.pose != first.pose
            seeds.add(other.noise_seed)
    assert len(seeds) == 15


def fixed(item: SceneObject) -> SceneObject:
    return item.model_copy(update={"position": (0.0, 0.0, 0.0), "rotation": (1.0, 0.0, 0.0, 0.0)})


def test_a_moving_camera_sees_the_same_path_from_known_poses(make_spec: MakeSpec) -> None:
    """The panel stays on the line of sight and parallel to the image, and so halves the cylinder in every frame."""
    spec = make_spec("sequence", frames=8, frame_rate=2.0, half_hidden=True, speed=0.05)
    moving = spec.model_copy(update=MOVING_CAMERA)
    for index in range(16):
        np.testing.assert_allclose(in_camera(moving, index), in_camera(spec, index), atol=1e-9)
        records = [described(one, "test", index) for one in (spec, moving)]
        assert abs(records[0].visibility - records[1].visibility) < 0.2
        panel = records[1].objects[-1]
        turned = rotation_matrix(records[1].pose.rotation) @ rotation_matrix(panel.rotation)
        np.testing.assert_allclose(turned[2], [0, 0, 1], atol=1e-9)


def test_a_record_has_the_name_of_its_sequence_its_time_and_its_pose(make_spec: MakeSpec) -> None:
    spec = make_spec("sequence", frames=4, frame_rate=8.0, **MOVING_CAMERA)
    records = [described(spec, "test", index) for index in range(8)]
    assert [record.track for record in records] == ["0"] * 4 + ["1"] * 4
    assert [record.time for record in records] == [0, 0.125, 0.25, 0.375] * 2
    assert [record.scene for record in records] == list(range(8)), "lines of one scene are of one time"
    for record in records:
        R, t = rotation_matrix(record.pose.rotation), np.array(record.pose.translation)
        np.testing.assert_allclose(R @ record.objects[0].position + t, (record.x, record.y, record.z), atol=1e-12)
    single = described(make_spec(), "test", 0).model_dump()
    assert not single.keys() & {"track", "time"}, "records of single images stay as they were"


@pytest.mark.kernels
def test_a_further_camera_follows_the_cylinder_and_sees_the_same_scene(make_spec: MakeSpec) -> None:
    """View 0 is that of one camera, and frame 0 that of single images from two; the later frames are smooth."""
    several, places = {"views": 2, "view_angle_range": (20.0, 60.0)}, []
    for scene in range(3):
        single = sample_scene(make_spec("scale", **several), "test", 2 * scene + 1)
        assert single == sample_scene(make_spec("sequence", frames=6, **several), "test", 12 * scene + 1)
    spec = make_spec("sequence", frames=6, occluders=True, **several)
    one = make_spec("sequence", frames=6, occluders=True)
    for index in range(60):
        first, second = (sample_scene(spec, "test", 2 * index + view) for view in range(2))
        assert first == sample_scene(one, "test", index)
        assert second.objects == first.objects
        seen = np.array([in_camera_frame(np.array(item.position), second.pose) for item in second.objects])
        assert seen[:, 2].min() >= 0.5
        places.append(np.append(seen[0, :2] / seen[0, 2] * (2 * second.f / spec.sensor_size), seen[0, 2]))
        assert second.pose.rotation == sample_scene(spec, "test", 12 * (index // 6) + 1).pose.rotation
    across, depth = np.array(places)[:, :2], np.array(places)[:, 2]
    assert np.abs(across).max() <= 1
    assert 3 <= depth.min() < depth.max() <= 5
    steps = np.diff(np.array(places).reshape(10, 6, 3), axis=1)
    assert 0.001 < np.abs(steps).max() < 0.5
    record = described(spec, "test", 15)
    assert (record.track, record.time, record.scene, record.view) == ("1", 1 / 30, 7, 1)


def test_the_camera_moves_as_specified(make_spec: MakeSpec) -> None:
    spec = make_spec("sequence", frames=3, frame_rate=100.0, **MOVING_CAMERA)
    poses = [[sample_scene(spec, "test", 3 * n + k).pose for k in (1, 2)] for n in range(300)]
    centres = np.array([[-rotation_matrix(p.rotation).T @ p.translation for p in pair] for pair in poses])
    speeds = (centres[:, 1] - centres[:, 0]) * spec.frame_rate
    np.testing.assert_allclose(np.sqrt((speeds**2).mean(0)), 0.3, rtol=0.15)
    turns = [rotation_matrix(b.rotation) @ rotation_matrix(a.rotation).T for a, b in poses]
    rates = np.degrees(Rotation.from_matrix(turns).as_rotvec()) * spec.frame_rate
    np.testing.assert_allclose(np.sqrt((rates**2).mean(0)), 8.0, rtol=0.15)
