"""Pictures show the objects where the scene says, and nothing but the backdrop elsewhere."""

from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.scenes import Backdrop, SampleRecord
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Box
from phd_exp.rendering.compose import REACH, backdrop_pixels, box_around, grown
from phd_exp.rendering.visibility import cylinder_mask, depth_maps, silhouettes
from phd_exp.rendering.workers import ensure_rendered


@pytest.fixture(scope="module")
def centred(make_spec: Callable[..., DatasetSpec], tmp_path_factory: pytest.TempPathFactory) -> DatasetFolder:
    """Cylinders that lie within the image as a whole."""
    folder = DatasetFolder(tmp_path_factory.mktemp("centred") / "default")
    ensure_rendered(folder, make_spec(xy_range=0.2), n_train=8, n_test=0)
    return folder


def pixels(folder: DatasetFolder, record: SampleRecord) -> np.ndarray:
    with Image.open(folder.split_folder(record.split) / record.file_name) as image:
        assert image.size == (record.S, record.S)
        assert image.mode == "RGB"
        return np.asarray(image).astype(int)


def test_grown_is_the_neighbourhood() -> None:
    mask = np.zeros((9, 9), dtype=bool)
    mask[0, 4] = True
    expected = np.zeros((9, 9), dtype=bool)
    expected[:3, 2:7] = True
    assert (grown(mask, 2) == expected).all()
    assert (grown(mask, 0) == mask).all()


def test_a_box_holds_the_mask_and_stays_in_the_image() -> None:
    mask = np.zeros((20, 20), dtype=bool)
    mask[3:5, 9:20] = True
    assert box_around(mask, 0) == Box(left=9, top=3, right=20, bottom=5)
    assert box_around(mask, 4) == Box(left=5, top=0, right=20, bottom=9)


def test_the_backdrop_is_its_formula() -> None:
    backdrop = Backdrop(level=0.6, falloff=0.4, centre=(0.25, 0.5))
    image = backdrop_pixels(backdrop, 8)
    light = 0.6 * (1 - 0.4 * ((7.5 / 8 - 0.25) ** 2 + (0.5 / 8 - 0.5) ** 2))
    assert image[0, 7].tolist() == [round(255 * (1.055 * light ** (1 / 2.4) - 0.055))] * 3


@pytest.mark.parametrize("variant", ["default", "occl", "scale", "occl_scale"])
def test_objects_are_where_the_scene_says(rendered: dict[str, DatasetFolder], variant: str) -> None:
    """No pixel within a silhouette shows the backdrop, and from two pixels beyond none shows anything else.

    In between, the tracer's own backdrop meets the formula's: its shader is the same function.
    """
    folder = rendered[variant]
    for record in folder.records("train"):
        away = np.abs(pixels(folder, record) - backdrop_pixels(record.backdrop, record.S)).max(axis=-1)
        mask = silhouettes(depth_maps(record.shown))
        inner = ~grown(~mask, 1)
        assert (away[inner] > 8).all()
        assert (away[~grown(mask, REACH)] == 0).all()
        assert np.median(away[grown(mask, REACH) & ~grown(mask, 1)]) <= 4


@pytest.mark.parametrize("variant", ["default", "occl", "scale", "occl_scale"])
def test_the_cylinder_has_the_colour_of_its_record(rendered: dict[str, DatasetFolder], variant: str) -> None:
    """Its visible pixels have its hue on average: under white lamps both materials keep it."""
    for record in rendered[variant].records("train"):
        mask = ~grown(~cylinder_mask(depth_maps(record.shown)), 1)
        if mask.sum() > 50:
            colour = pixels(rendered[variant], record)[mask].mean(axis=0)
            assert int(colour.argmax()) == int(np.argmax(record.objects[0].colour))


def test_silhouettes_have_no_bias(centred: DatasetFolder) -> None:
    """The centroid of what differs from the backdrop, against the analytic one, in pixels."""
    offsets = []
    for record in centred.records("train"):
        image = pixels(centred, record)
        away = np.abs(image - backdrop_pixels(record.backdrop, record.S)).max(axis=-1)
        mask = silhouettes(depth_maps(record.shown))
        assert not (mask[0] | mask[-1] | mask[:, 0] | mask[:, -1]).any()
        seen = np.argwhere(away > 10).mean(axis=0)
        offsets.append(seen - np.argwhere(mask).mean(axis=0))
    assert np.abs(offsets).max() < 0.5
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.1


def test_paired_variants_show_the_same_light(rendered: dict[str, DatasetFolder]) -> None:
    """Where neither has an object, paired images are equal; where they differ, an object is the reason."""
    for index in range(5):
        alone, occluded = (rendered[variant].records("train")[index] for variant in ("default", "occl"))
        free = ~grown(silhouettes(depth_maps(occluded.shown)), REACH)
        difference = np.abs(pixels(rendered["default"], alone) - pixels(rendered["occl"], occluded))
        assert (difference[free] == 0).all()
