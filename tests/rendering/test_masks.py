"""Masks are the pixels that the records count."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import DatasetError, RenderError
from phd_exp.rendering.masks import write_masks
from phd_exp.rendering.rays import cylinder_mask, trace_pixels


def test_a_mask_for_every_sample(rendered: dict[str, DatasetFolder], tmp_path: Path) -> None:
    folder = rendered["occl"]
    assert write_masks(folder, tmp_path / "masks") == 6
    for record in folder.records("train"):
        with Image.open(tmp_path / "masks" / "train" / record.file_name) as image:
            assert image.mode == "1"
            mask = np.asarray(image)
        hits = trace_pixels(record.shown)
        assert (mask == cylinder_mask(hits)).all()
        alone = np.isfinite(hits.depths[0]).sum()
        assert mask.sum() == pytest.approx(record.visibility * alone)
    assert (tmp_path / "masks" / "test" / "000000.png").exists()


def test_masks_do_not_lie_among_the_images(small: DatasetFolder) -> None:
    with pytest.raises(RenderError, match=r"masks=.*: lies in the data set itself"):
        write_masks(small, small.root / "train" / "masks")


def test_masks_that_cannot_be_written_are_one_line(small: DatasetFolder, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RenderError, match=r"cannot be written .* choose another masks=FOLDER"):
        write_masks(small, tmp_path / "file" / "masks")


def test_no_data_set_no_masks(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no data set here"):
        write_masks(DatasetFolder(tmp_path / "none"), tmp_path / "masks")
