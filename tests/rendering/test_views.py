"""Several views of one scene: one geometry, and each view alone as any first view is."""

from itertools import combinations

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from phd_exp.records.scenes import Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.sampling import CLEARANCE, sample_scene
from tests.support.renders import UNLIKELY, MakeSpec, described

SCENES, VIEWS = 200, 4


@pytest.fixture(scope="module")
def spec(make_spec: MakeSpec) -> DatasetSpec:
    return make_spec("multiview")


@pytest.fixture(scope="module")
def seen(spec: DatasetSpec) -> list[list[Scene]]:
    """The views of each scene."""
    return [[sample_scene(spec, "train", VIEWS * scene + view) for view in range(VIEWS)] for scene in range(SCENES)]


def motion(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """R and t of a view's pose, by another implementation than the renderer's."""
    w, x, y, z = scene.pose.rotation
    return Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(scene.pose.translation)


def places(scene: Scene) -> np.ndarray:
    """Where all objects stand before the camera (objects, 3), m."""
    matrix, shift = motion(scene)
    return np.array([item.position for item in scene.objects]) @ matrix.T + shift


def test_the_first_view_is_the_sample_of_scale(spec: DatasetSpec, make_spec: MakeSpec) -> None:
    scale = make_spec("scale")
    assert spec.views == VIEWS
    for split in ("train", "test"):
        for scene in range(20):
            assert sample_scene(spec, split, VIEWS * scene) == sample_scene(scale, split, scene)


def test_a_record_holds_the_position_before_its_own_camera(spec: DatasetSpec) -> None:
    """(x, y, z) = R p + t; number of the scene and of the view are those of the index."""
    for index in range(12):
        record = described(spec, "test", index)
        assert (record.x, record.y, record.z) == pytest.approx(tuple(places(record.as_scene)[0]), abs=1e-12)
        assert (record.scene, record.view) == (index // VIEWS, index % VIEWS)
        assert record.objects == described(spec, "test", VIEWS * record.scene).objects


def test_views_share_the_scene_and_nothing_of_the_camera(seen: list[list[Scene]]) -> None:
    for views in seen[:50]:
        for one, other in combinations(views, 2):
            assert one.objects == other.objects
            assert one.lamps == other.lamps
            for key in ("f", "pose", "backdrop", "noise_seed"):
                assert getattr(one, key) != getattr(other, key)


def test_every_view_has_the_cylinder_in_its_field(spec: DatasetSpec, seen: list[list[Scene]]) -> None:
    for scene in (scene for views in seen for scene in views):
        x, y, z = places(scene)[0]
        assert spec.z_range[0] <= z <= spec.z_range[1]
        assert max(abs(x), abs(y)) <= scene.S * z / scene.f / 2 * (1 + 1e-9)


def test_lines_of_sight_are_turned_by_an_angle_of_the_range(spec: DatasetSpec, seen: list[list[Scene]]) -> None:
    """Uniformly within it, and towards all sides."""
    matrices = np.array([motion(scene)[0] for views in seen for scene in views[1:]])
    ahead = matrices[:, 2]  # a further camera's line of sight in the frame of the first
    angles = np.degrees(np.arccos(ahead[:, 2]))
    low, high = spec.view_angle_range
    assert low <= angles.min() <= angles.max() <= high
    assert stats.kstest(angles, stats.uniform(low, high - low).cdf).pvalue > UNLIKELY
    sides = np.arctan2(ahead[:, 1], ahead[:, 0])
    assert stats.kstest(sides, stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > UNLIKELY


@pytest.mark.parametrize("view", range(VIEWS))
def test_each_view_alone_follows_the_law_of_the_first(spec: DatasetSpec, seen: list[list[Scene]], view: int) -> None:
    """Focal length, depth, projected position and, before its camera, the cylinder's rotation."""
    scenes = [views[view] for views in seen]
    x, y, z = np.array([places(scene)[0] for scene in scenes]).T
    f = np.array([scene.f for scene in scenes])
    turned = np.array([motion(scene)[0] for scene in scenes]) @ np.array(
        [Rotation.from_quat(np.roll(scene.objects[0].rotation, -1)).as_matrix() for scene in scenes]
    )
    drawn = {"f": (f, spec.f_range), "z": (z, spec.z_range)}
    drawn |= {name: (place * f / (scenes[0].S * z), (-0.5, 0.5)) for name, place in (("x", x), ("y", y))}
    drawn |= {f"axis {row}": (turned[:, row, 2], (-1.0, 1.0)) for row in range(3)}
    for name, (values, (low, high)) in drawn.items():
        assert stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue > UNLIKELY, name


def test_the_depth_of_one_view_tells_nothing_of_that_of_another(seen: list[list[Scene]]) -> None:
    depths = np.array([[places(scene)[0, 2] for scene in views] for views in seen])
    correlation = np.corrcoef(depths.T)[~np.eye(VIEWS, dtype=bool)]
    assert np.abs(correlation).max() < 4 / SCENES**0.5


def nearest(spec: DatasetSpec) -> list[float]:
    """Depth of the nearest object before each further camera, m."""
    indices = (index for index in range(SCENES) if index % VIEWS)
    return [float(places(sample_scene(spec, "train", index))[:, 2].min()) for index in indices]


def test_no_object_comes_near_a_camera(make_spec: MakeSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    """Among occluders as configured no draw is ever refused, so that the laws above hold there to the letter."""
    usual = make_spec("multiview", occluders=True)
    crowded = make_spec("multiview", occluders=True, z_range=(0.5, 5.0), view_angle_range=(60.0, 90.0))
    as_drawn, kept = nearest(usual), nearest(crowded)
    assert min(as_drawn) >= CLEARANCE == 0.5
    assert min(kept) >= CLEARANCE
    monkeypatch.setattr("phd_exp.rendering.sampling.CLEARANCE", -100.0)
    assert nearest(usual) == as_drawn
    assert min(nearest(crowded)) < 0.5


def test_a_view_that_cannot_be_is_said(make_spec: MakeSpec, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("phd_exp.rendering.sampling.MOST_TRIES", 0)
    with pytest.raises(ValueError, match=r"no camera sees all 3 objects: lower view_angle_range"):
        sample_scene(make_spec("multiview", occluders=True), "train", 1)


def test_a_view_does_not_depend_on_the_number_of_views(spec: DatasetSpec, make_spec: MakeSpec) -> None:
    scene = sample_scene(spec, "train", 6)
    fewer, more = make_spec("multiview", views=3), make_spec("multiview", views=8)
    assert sample_scene(fewer, "train", 3 + 2) == scene == sample_scene(more, "train", 8 + 2)
