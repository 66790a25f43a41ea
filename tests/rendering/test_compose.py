"""Pictures show the objects where the scene says, and nothing but the backdrop elsewhere."""

import numpy as np
import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.scenes import Backdrop, SampleRecord
from phd_exp.rendering.antialias import REACH, edges
from phd_exp.rendering.blender import Box
from phd_exp.rendering.pixels import encoded
from phd_exp.rendering.rays import Hits, cylinder_mask, trace_pixels
from phd_exp.rendering.samples import backdrop_light, box_around
from tests.support.renders import pixels, silhouettes


def backdrop_pixels(record: SampleRecord) -> np.ndarray:
    return encoded(backdrop_light(record.backdrop, record.S)).astype(int)


def test_a_box_holds_the_mask_and_stays_in_the_image() -> None:
    mask = np.zeros((20, 20), dtype=bool)
    mask[3:5, 9:20] = True
    assert box_around(mask, 0) == Box(left=9, top=3, right=20, bottom=5)
    assert box_around(mask, 4) == Box(left=5, top=0, right=20, bottom=9)


def test_the_backdrop_is_its_formula() -> None:
    backdrop = Backdrop(level=0.6, falloff=0.4, centre=(0.25, 0.5))
    light = 0.6 * (1 - 0.4 * ((7.5 / 8 - 0.25) ** 2 + (0.5 / 8 - 0.5) ** 2))
    assert backdrop_light(backdrop, 8)[0, 7] == pytest.approx([light] * 3)
    assert encoded(np.array([light])) == round(255 * (1.055 * light ** (1 / 2.4) - 0.055))


def test_every_value_of_a_picture_stands_for_its_light() -> None:
    values = np.arange(256)
    signal = values / 255
    light = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
    assert (encoded(light) == values).all()
    assert encoded(np.array([-0.1, 1.5, 100.0])).tolist() == [0, 255, 255]


def away_from_objects(folder: DatasetFolder, record: SampleRecord) -> tuple[np.ndarray, Hits]:
    """Differences to the backdrop (S, S), which are 0 beyond the reach of the filter; and what rays meet.

    So the box that the path tracer renders leaves no seam, and nothing but the objects tells where they are.
    """
    image, hits = pixels(folder, record), trace_pixels(record.as_scene)
    away = np.abs(image - backdrop_pixels(record)).max(axis=-1)
    mask = silhouettes(hits)
    near_an_edge = edges(mask.astype(np.int8), REACH)
    free = ~mask & ~near_an_edge
    assert free.any()
    assert (away[free] == 0).all()
    return away, hits


def test_objects_are_where_the_scene_says(rendered: DatasetFolder) -> None:
    """Inside a silhouette, no pixel is backdrop; beyond the reach of the filter, all pixels are its formula.

    The visible pixels of a cylinder have its hue on average: under white lamps both materials keep it.
    """
    compared = 0
    for record in rendered.records("train"):
        away, hits = away_from_objects(rendered, record)
        mask = silhouettes(hits)
        assert (away[mask & ~edges(mask.astype(np.int8), REACH)] > 8).all()
        cylinder = cylinder_mask(hits)
        cylinder &= ~edges(cylinder.astype(np.int8), 1)
        if cylinder.sum() > 20:
            compared += 1
            colour = pixels(rendered, record)[cylinder].mean(axis=0)
            assert int(colour.argmax()) == int(np.argmax(record.objects[0].colour))
    assert compared >= 2


def test_silhouettes_have_no_bias(centred: DatasetFolder) -> None:
    """The centroid of what differs from the backdrop, against the analytic one, in pixels."""
    offsets = []
    for record in centred.records("train"):
        away, hits = away_from_objects(centred, record)
        mask = silhouettes(hits)
        assert not (mask[0] | mask[-1] | mask[:, 0] | mask[:, -1]).any()
        seen = np.argwhere(away > 10).mean(axis=0)
        offsets.append(seen - np.argwhere(mask).mean(axis=0))
    assert np.abs(offsets).max() < 0.5
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.1
