"""One picture of several data sets side by side: a row for each, the same indices in each column."""

import io
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.files import write_atomic
from phd_exp.records.scenes import Split
from phd_exp.rendering.errors import RenderError

GAP = 4  # px of white between pictures
QUALITY = 88


def draw_gallery(
    path: Path, folders: Sequence[DatasetFolder], indices: Sequence[int], split: Split = "train"
) -> None:
    """Write a JPEG of the images `indices` of every folder; all of them have to be rendered already.

    Raises:
        RenderError: there is nothing to draw, or an image is missing.
    """
    if not folders or not indices:
        raise RenderError(f"{path}: a gallery needs at least one data set and one index")
    rows = [[_open(folder.image_path(split, index)) for index in indices] for folder in folders]
    side = max(image.width for row in rows for image in row) + GAP
    sheet = Image.new("RGB", (len(indices) * side - GAP, len(folders) * side - GAP), "white")
    for y, row in enumerate(rows):
        for x, image in enumerate(row):
            sheet.paste(image, (x * side, y * side))
    stream = io.BytesIO()
    sheet.save(stream, format="JPEG", quality=QUALITY)
    write_atomic(path, stream.getvalue())


def _open(path: Path) -> Image.Image:
    try:
        with Image.open(path) as image:
            return image.convert("RGB")
    except FileNotFoundError:
        raise RenderError(f"{path}: not rendered yet; render this data set first") from None
