"""Nothing but the objects tells where they are: the box that the path tracer renders leaves no seam."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.scenes import SampleRecord
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.antialias import REACH, edges
from phd_exp.rendering.blender import Box
from phd_exp.rendering.pixels import encoded
from phd_exp.rendering.rays import Mask, trace_pixels
from phd_exp.rendering.render import ensure_rendered
from phd_exp.rendering.samples import MARGIN, backdrop_light, box_around
from tests.support.renders import pixels, silhouettes

MANY = 1000
UNLIKELY = 4.0  # standard errors


class Picture(NamedTuple):
    """An image (S, S, 3), its pixels that no object touches, and the box that was rendered."""

    pixels: np.ndarray
    free: Mask
    box: Box
    record: SampleRecord


def pictures(folder: DatasetFolder) -> list[Picture]:
    """Training images at a quarter of the sensor that show any object."""
    records, found = folder.records("train"), []
    for record in records:
        shown = silhouettes(trace_pixels(record.shown))
        if shown.any():
            free = ~shown & ~edges(shown.astype(np.int8), REACH)
            found.append(Picture(pixels(folder, record), free, box_around(shown, MARGIN), record))
    assert len(found) > 0.9 * len(records)
    return found


def steps(picture: Picture, box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Largest difference over colours of free neighbours: those with a box's border between them, and all others."""
    inside = np.zeros_like(picture.free)
    inside[box.top : box.bottom, box.left : box.right] = True
    across, elsewhere = [], []
    for axis in (0, 1):
        image, free, within = (np.moveaxis(map_, axis, 0) for map_ in (picture.pixels, picture.free, inside))
        step = np.abs(np.diff(image, axis=0)).max(axis=-1)
        both, border = free[1:] & free[:-1], within[1:] != within[:-1]
        across.append(step[both & border])
        elsewhere.append(step[both & ~border])
    return np.concatenate(across), np.concatenate(elsewhere)


def check_formula(found: list[Picture]) -> None:
    """Beyond the reach of the filter, every pixel is the backdrop's formula, inside the box and outside it."""
    for picture in found:
        expected = encoded(backdrop_light(picture.record.backdrop, picture.record.S))
        assert picture.free.any()
        assert (picture.pixels[picture.free] == expected[picture.free]).all()


def check_borders(found: list[Picture]) -> None:
    """A picture changes across its own box's border as across that of the next picture's box, and as elsewhere.

    Boxes and backdrops are drawn independently, so that without a seam the two differ by chance alone.
    """
    own, foreign, rest = [], [], []
    for picture, other in pairwise([*found, found[0]]):
        across, elsewhere = steps(picture, picture.box)
        strange, _ = steps(picture, other.box)
        if len(across) and len(strange):
            own.append(across)
            foreign.append(strange)
            rest.append(elsewhere)
    excess = np.array([one.mean() - other.mean() for one, other in zip(own, foreign, strict=True)])
    assert len(excess) > 0.5 * len(found), "a box may fill the image, and then has no border"
    assert abs(excess.mean()) < UNLIKELY * excess.std() / len(excess) ** 0.5
    assert abs(np.concatenate(own).max() - np.concatenate(foreign).max()) <= 1
    assert np.concatenate(own).max() <= np.concatenate(rest).max()


def test_a_few_images_have_no_seam(small: DatasetFolder) -> None:
    few = pictures(small)
    check_formula(few)
    check_borders(few)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_thousand_images_have_no_seam(make_spec: Callable[..., DatasetSpec], tmp_path: Path) -> None:
    folder = DatasetFolder(tmp_path / "occl_scale")
    ensure_rendered(folder, make_spec("occl_scale", sensor_size=56, f_range=(300.0, 500.0)), MANY, 0)
    many = pictures(folder)
    check_formula(many)
    check_borders(many)
