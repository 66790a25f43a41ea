"""The pictures of `README.md` and `renders/README.md`, into `renders/` or another folder.

python renders/draw.py [FOLDER]               # gallery.jpg: paired data sets; camera.png: the camera's axes
python renders/draw.py FOLDER RUN IMAGES      # glance.png: a prediction of a run, given its test images
"""

import io
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from phd_exp.cli.jobs import composed
from phd_exp.config import check_render
from phd_exp.distributions.level_curves import LevelCurves
from phd_exp.evaluation.parquet import read_table
from phd_exp.records.files import write_atomic
from phd_exp.records.runs import RunFolder
from phd_exp.records.scenes import SampleRecord, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer
from phd_exp.rendering.pixels import file_of
from phd_exp.rendering.rays import cylinder_mask, trace_pixels
from phd_exp.rendering.samples import fast_settings, make_sample
from phd_exp.reports.figures import draw_birds_eye, draw_curve, draw_on_image, encoded
from phd_exp.reports.gallery import curves_of, load_image

VARIANTS = ("default", "occl", "scale", "occl_scale")
INDICES = (0, 3, 6, 8, 12, 14)

GAP = 4  # px of white between pictures
QUALITY = 88
SPLIT: Split = "train"
ZOOM = 4
INK, MARK = (20, 20, 20), (200, 0, 60)
CURVES = "#e06000"  # visible on an image and on white
LABEL = 28  # px above each row of the gallery
PIXEL = 96  # px of the drawing that one pixel takes where two of them are explained


def draw_gallery(path: Path, specs: Sequence[DatasetSpec], indices: Sequence[int]) -> None:
    """Write a JPEG of the same samples of every data set, rendered for it: a labelled row each, a column a sample.

    Raises:
        RenderError: bpy is missing.
    """
    rows = [[image for image, _ in _samples(spec, indices)] for spec in specs]
    side = max(image.width for row in rows for image in row) + GAP
    sheet = Image.new("RGB", (len(indices) * side - GAP, len(specs) * (side + LABEL) - GAP), "white")
    draw = ImageDraw.Draw(sheet)
    for y, (spec, row) in enumerate(zip(specs, rows, strict=True)):
        top = y * (side + LABEL) + LABEL
        draw.text((2, top - 4), f"data={spec.variant}", INK, _font(18), anchor="ls")
        for x, image in enumerate(row):
            sheet.paste(image, (x * side, top))
    write_atomic(path, file_of(sheet, "jpeg", quality=QUALITY))


def draw_glance(path: Path, run: RunFolder, images: Path) -> None:
    """Write a PNG of a run's prediction with the median score, its truth, and the calibration of all."""
    table = read_table(run.predictions)
    place = int(np.argsort(table["nll"])[len(table["nll"]) // 2])
    row = {name: column[place] for name, column in table.items()}
    image, curves = load_image(images, str(row["file_name"])), curves_of(row)
    assert image is not None, row["file_name"]
    assert curves is not None, "a baseline predicts no region"
    calibration = json.loads(run.curves("final").read_text())["depth"]
    write_atomic(path, encoded(glance(row, np.asarray(image), curves, calibration), "png", dpi=110))


def glance(row: Mapping[str, Any], image: np.ndarray, curves: LevelCurves, calibration: Mapping[str, Any]) -> Figure:
    """A prediction on its image and from above, and the calibration of depth; one legend for all three."""
    figure, truth = Figure(figsize=(12.6, 4.7), layout="constrained"), np.array([row[axis] for axis in "xyz"])
    seen, above, calibrated = figure.subplots(1, 3)
    draw_on_image(seen, curves, image, float(row["f"]), float(row["S"]), truth)
    draw_birds_eye(above, curves, truth)
    draw_curve(calibrated, "depth", calibration)
    for *lines, dot in (seen.lines, above.lines):
        for line in lines:
            line.set_color(CURVES)
        dot.set(color="white", markeredgecolor="black")
    seen.set_title("Prediction on the test image")
    above.set_title("The same from above; x and z differ in scale")
    calibrated.set_title("Depth: squared errors and their prediction")
    handles = [*above.get_legend_handles_labels()[0], *calibrated.get_legend_handles_labels()[0]]
    for axes in (above, calibrated):
        axes.get_legend().remove()
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def draw_camera(path: Path, spec: DatasetSpec, index: int) -> None:
    """Write a PNG of one sample with the camera's axes, the principal point, and the truth of its record on top.

    Raises:
        RenderError: bpy is missing.
    """
    ((image, record),) = _samples(spec, [index])
    side = ZOOM * record.S
    sheet = Image.new("RGB", (side + 3 * PIXEL, side), "white")
    sheet.paste(image.resize((side, side), Image.Resampling.NEAREST))
    draw = ImageDraw.Draw(sheet)
    _draw_truth(draw, record)
    _draw_axes(draw, side)
    _draw_pixels(draw, side + PIXEL // 2)
    write_atomic(path, file_of(sheet, "png"))


def _samples(spec: DatasetSpec, indices: Sequence[int]) -> list[tuple[Image.Image, SampleRecord]]:
    renderer = Renderer(fast_settings(spec))
    made = [make_sample(renderer, spec, SPLIT, index) for index in indices]
    return [(Image.open(io.BytesIO(content)).convert("RGB"), record) for content, record in made]


def _draw_truth(draw: ImageDraw.ImageDraw, record: SampleRecord) -> None:
    """The outline of the cylinder's mask, and its centre as the record's x, y, z, f and S place it."""
    mask = np.pad(cylinder_mask(trace_pixels(record.as_scene)), 1)
    for row, column in np.argwhere(mask[:, 1:] != mask[:, :-1]):
        draw.line([(ZOOM * column, ZOOM * (row - 1)), (ZOOM * column, ZOOM * row)], MARK, 2)
    for row, column in np.argwhere(mask[1:] != mask[:-1]):
        draw.line([(ZOOM * (column - 1), ZOOM * row), (ZOOM * column, ZOOM * row)], MARK, 2)
    u, v = (ZOOM * (record.f * place / record.z + record.S / 2) for place in (record.x, record.y))
    _dot(draw, u, v, MARK)
    lines = (
        "red: truth of the record",
        f"x {record.x:.3f}  y {record.y:.3f}  z {record.z:.3f} m",
        f"f {record.f:.1f}  S {record.S} px",
        "centre seen at",
        "(f x/z + S/2, f y/z + S/2)",
        f"= ({u / ZOOM:.1f}, {v / ZOOM:.1f})",
        "outline: its mask",
    )
    draw.multiline_text((ZOOM * record.S + PIXEL // 2, 4 * PIXEL), "\n".join(lines), MARK, _font(16))


def _draw_axes(draw: ImageDraw.ImageDraw, side: int) -> None:
    middle, reach = side / 2, side / 5
    _arrow(draw, (middle, middle), (middle + reach, middle))
    _arrow(draw, (middle, middle), (middle, middle + reach))
    _dot(draw, middle, middle, INK)
    draw.text((middle + reach + 8, middle - 10), "x", INK, _font(20))
    draw.text((middle + 8, middle + reach - 10), "y", INK, _font(20))
    draw.text((middle + 14, middle - 30), "principal point (S/2, S/2)", INK, _font(16))
    draw.text((middle + 14, middle + 10), "z goes in", INK, _font(16))
    draw.text((6, 4), "(0, 0)", INK, _font(16))
    draw.text((side - 60, side - 24), "(S, S)", INK, _font(16))


def _draw_pixels(draw: ImageDraw.ImageDraw, left: int) -> None:
    """Two pixels of the top row, large."""
    for column in (0, 1):
        x = left + column * PIXEL
        draw.rectangle((x, PIXEL, x + PIXEL, 2 * PIXEL), outline=INK, width=2)
        _dot(draw, x + PIXEL / 2, 1.5 * PIXEL, MARK)
        draw.text((x + 20, 2 * PIXEL + 6), f"({column}.5, 0.5)", MARK, _font(14))
    text = "pixels of column 0 and 1,\nrow 0: a pixel's middle is\nhalf a pixel from its corner"
    draw.multiline_text((left, 2 * PIXEL + 40), text, INK, _font(14))


def _arrow(draw: ImageDraw.ImageDraw, begin: tuple[float, float], end: tuple[float, float]) -> None:
    draw.line([begin, end], INK, 3)
    (x, y), along = end, np.array(end) - np.array(begin)
    right, down = 10 * along / np.hypot(*along)
    draw.polygon([(x + right, y + down), (x - down, y + right), (x + down, y - right)], INK)


def _dot(draw: ImageDraw.ImageDraw, x: float, y: float, colour: tuple[int, int, int]) -> None:
    draw.ellipse((x - 5, y - 5, x + 5, y + 5), colour)


def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _spec(variant: str) -> DatasetSpec:
    return check_render(composed([f"data={variant}"], config_name="render")).data.spec


if __name__ == "__main__":
    folder, *of_run = [Path(word) for word in sys.argv[1:]] or [Path(__file__).parent]
    if of_run:
        draw_glance(folder / "glance.png", RunFolder(of_run[0]), of_run[1])
        sys.exit()
    specs = [_spec(variant) for variant in VARIANTS]
    draw_gallery(folder / "gallery.jpg", specs, INDICES)
    draw_camera(folder / "camera.png", specs[0], INDICES[4])
