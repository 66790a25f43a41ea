"""A video of a followed object: level curves on the image, and from above with the path so far."""

import math
from collections import deque
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont

from phd_exp.distributions.level_curves import LEVELS, Points
from phd_exp.inference.following import Followed
from phd_exp.records.videos import VideoWriter

Pixel = tuple[float, float]
COLOURS = {"tracked": "#ffb000", "bridged": "#fe6100", "lost": "#dc267f"}
WIDTHS = (3, 2, 1)  # of the lines of 50, 90 and 99 %
RADII = [math.sqrt(-2 * math.log(1 - level)) for level in LEVELS]  # of a Gaussian in two dimensions, in deviations
TRAIL = 300  # latest positions that are drawn
ABOVE = 0.75  # width of the view from above over the height of the image
MARGIN = 0.08  # of the view from above
LARGEST = 960  # px along the longer side of the image in the video
CIRCLE = np.stack([np.cos(np.linspace(0, 2 * np.pi, 49)), np.sin(np.linspace(0, 2 * np.pi, 49))], -1)


class PathVideo:
    """Writes frames with what is known of the object; in the frame of the camera, metres.

    The curves contain 50, 90 and 99 % of the Gaussian with the path's mean and covariance: its projections on the
    image and on the plane of x and z. The view from above grows with the path.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self._writer: VideoWriter | None = None
        self._trail: deque[Points] = deque(maxlen=TRAIL)
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)

    def add(self, followed: Followed) -> None:
        """Draw and append a frame."""
        canvas = self.drawn(followed)
        if self._writer is None:
            self._writer = VideoWriter(self._file, canvas.size)
        self._writer.add(followed.frame.time, np.asarray(canvas))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, place: TracebackType | None
    ) -> None:
        if self._writer:
            self._writer.__exit__(kind, error, place)

    def drawn(self, followed: Followed) -> Image.Image:
        """The image of a frame with curves and text, and the view from above on its right."""
        image = Image.fromarray(followed.frame.image)
        zoom = min(1.0, LARGEST / max(image.size))
        image = image.resize((max(2, round(zoom * image.width)), max(2, round(zoom * image.height))))
        above = Image.new("RGB", (round(ABOVE * image.height), image.height), "white")
        colour = COLOURS[followed.status]
        draw = ImageDraw.Draw(image)
        if followed.box:
            draw.rectangle([zoom * value for value in followed.box], outline="white")
        if followed.state is not None:
            for curve, width in zip(_on_image(followed), WIDTHS, strict=True):
                draw.line([tuple(point) for point in zoom * curve], fill=colour, width=width)
            self._draw_above(ImageDraw.Draw(above), above.size, followed)
        _draw_text(draw, image.size, followed)
        canvas = Image.new("RGB", (2 * ((image.width + above.width + 1) // 2), 2 * ((image.height + 1) // 2)))
        canvas.paste(image, (0, 0))
        canvas.paste(above, (image.width, 0))
        return canvas

    def _draw_above(self, draw: ImageDraw.ImageDraw, size: tuple[int, int], followed: Followed) -> None:
        mean, covariance = followed.in_camera
        curves = _ellipses(mean[[0, 2]], covariance[np.ix_([0, 2], [0, 2])])
        self._trail.append(mean[[0, 2]])
        self._low = np.minimum(self._low, curves[-1].min(0))
        self._high = np.maximum(self._high, curves[-1].max(0))
        scale = (1 - 2 * MARGIN) * min(np.array(size) / np.maximum(self._high - self._low, 1e-6))
        middle = (self._low + self._high) / 2

        def placed(points: Points) -> list[Pixel]:
            """Pixels: x to the right, z upwards."""
            offsets = scale * (points - middle) * (1, -1) + np.array(size) / 2
            return [(float(x), float(y)) for x, y in offsets]

        _draw_grid(draw, size, 10 ** math.floor(math.log10(min(size) / scale / 2)), placed)
        draw.line(placed(np.stack(list(self._trail))), fill="#648fff", width=2)
        for curve, width in zip(curves, WIDTHS, strict=True):
            draw.line(placed(curve), fill=COLOURS[followed.status], width=width)


def _on_image(followed: Followed) -> list[Points]:
    """The curves on the image, pixels: linear about the mean, and bent by the lens."""
    (mean, covariance), camera = followed.in_camera, followed.facing
    depth = np.linalg.norm(mean)
    across = (camera.R @ covariance @ camera.R.T)[:2, :2] / depth**2
    curves = [camera.real_pixels(curve) for curve in _ellipses(np.zeros(2), across)]
    return [curve[np.isfinite(curve).all(-1)] for curve in curves]


def _ellipses(mean: Float[np.ndarray, "2"], covariance: Float[np.ndarray, "2 2"]) -> list[Points]:
    """The level curves of a Gaussian."""
    L = np.linalg.cholesky(covariance)
    return [mean + radius * CIRCLE @ L.T for radius in RADII]


def _draw_text(draw: ImageDraw.ImageDraw, size: tuple[int, int], followed: Followed) -> None:
    text = f"{followed.frame.time:.2f} s  {followed.status}"
    if followed.state is not None:
        mean, covariance = followed.in_camera
        text += f"  z = {mean[2]:.3g} m, 90 % within {1.645 * np.sqrt(covariance[2, 2]):.2g} m"
    height = max(10, size[1] // 30)
    draw.text((4, 4), text, "white", ImageFont.load_default(height), stroke_width=2, stroke_fill="black")


def _draw_grid(
    draw: ImageDraw.ImageDraw, size: tuple[int, int], step: float, placed: Callable[[Points], list[Pixel]]
) -> None:
    """Lines every `step` metres, with their distance."""
    (x0, y0), (x1, y1) = placed(np.array([[0.0, 0.0], [step, step]]))
    font = ImageFont.load_default(max(10, size[1] // 36))
    for k in range(math.ceil(-x0 / (x1 - x0)), math.floor((size[0] - x0) / (x1 - x0)) + 1):
        x = x0 + k * (x1 - x0)
        draw.line([(x, 0), (x, size[1])], fill="#e0e0e0")
    for k in range(math.ceil((y0 - size[1]) / (y0 - y1)), math.floor(y0 / (y0 - y1)) + 1):
        y = y0 - k * (y0 - y1)
        draw.line([(0, y), (size[0], y)], fill="#e0e0e0")
        draw.text((2, y), f"{k * step:.3g} m", "#606060", font)
