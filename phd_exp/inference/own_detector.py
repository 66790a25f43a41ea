"""A detector without further training: the network's map of the object, in views that cover an image.

For each cell of a view, the map holds the probability that it shows the object. The network was trained with the
object in every image, so it marks some region in every view; where the object is absent, its map of the object's
place is spread out. So the views, on a grid at a few focal lengths of the training, are ordered by this spread. In
the first ones, the largest region proposes a box. Each box is viewed again as in training, twice, and replaced by
that of the region found there.

Source: own design; recall and precision are in docs/guides/predict.md.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import interpolate

from phd_exp.data.areas import GREY
from phd_exp.data.crops import cut
from phd_exp.inference.detectors import Detector, Found, area, common_area, overlap
from phd_exp.inference.predictor import BATCH, Predictor
from phd_exp.models.backbones import Backbone
from phd_exp.optics.lens import Lens
from phd_exp.optics.virtual import Box, VirtualCamera, enlarged
from phd_exp.records.errors import ConfigError, DatasetError

FOCAL_LENGTHS = (0.02, 0.6)  # quantiles of those of held-out views: an object is found smaller, but not larger
STEP = 1.6  # largest factor between two focal lengths
OVERHANG = 0.25  # of a view beyond the edge of the image, over its side
MOST_VIEWS = 4000  # of one image
FEWEST_CELLS = 6  # of a region
MOST_BOXES = 8  # that are viewed again
ROUNDS = 2
MARGIN = 1.2  # side of a view over that of its box
FINE = 4  # points along a cell at which its map is interpolated
CONTAINED = 0.5  # share of a box in one with a higher score that makes it a part of the same object
SPREAD = 0.025  # share of a view over which the place of an object is spread; more lowers the score
LEAST_SCORE = 0.5
LEAST_FAMILIAR = 0.01  # share of true views that are taken for something else


def own_detector(predictor: Predictor) -> Detector:
    """The detector of a run, of an ensemble that of its first network.

    Raises ConfigError if the network was not trained with a map of the object.
    """
    backbone, folder = predictor.regressor.backbone, predictor.folders[0]
    if not (isinstance(backbone, Backbone) and backbone.segments and predictor.config.recipe.segmentation):
        raise ConfigError(f"detect: {folder.path} has no map of the object; expected a run of recipe=strong")
    low, high = predictor.f_range
    if folder.held_out.exists():
        from phd_exp.evaluation.parquet import read_table, require_columns  # imports pyarrow

        table = read_table(folder.held_out)
        require_columns(("f", "S"), table)
        low, high = np.quantile(table["f"] / table["S"] * predictor.side, FOCAL_LENGTHS).tolist()
    if not 0 < low <= high < math.inf:
        raise ConfigError(f"detect: {folder.held_out} is missing; train with data.n_held_out > 0")
    levels = np.geomspace(low, high, 1 + math.ceil(math.log(high / low) / math.log(STEP)))
    return Detector("detect=true", _Search(predictor, levels.tolist()))


class _Region(NamedTuple):
    """A box in the image, px, and the higher, the more likely the object."""

    box: Box
    score: float


@dataclass(frozen=True, eq=False)
class _Search:
    """The function of the detector; focal lengths in pixels of the network's image."""

    predictor: Predictor
    focal_lengths: Sequence[float]

    def __call__(self, image: UInt8[np.ndarray, "height width 3"], K: Float[np.ndarray, "3 3"], lens: Lens) -> Found:
        picture = Image.fromarray(image)
        zooms = [f / math.sqrt(K[0, 0] * K[1, 1]) for f in self.focal_lengths]
        n = sum(math.prod(self._counts(picture, zoom)) for zoom in zooms)
        if n > MOST_VIEWS:
            raise DatasetError(
                f"{n} views cover an image of {picture.width} x {picture.height} pixels; expected at most "
                f"{MOST_VIEWS}; shrink the image and scale its camera, or use boxes="
            )
        found = _separate([region for zoom in zooms for region in self._proposed(picture, zoom)])[:MOST_BOXES]
        for _ in range(ROUNDS):
            found = self._seen_again(picture, K, lens, found)
        found = [one for one in _separate(found) if one.score >= LEAST_SCORE]
        return Found([one.box for one in found], [one.score for one in found], [None] * len(found))

    def _counts(self, picture: Image.Image, zoom: float) -> tuple[int, int]:
        """The columns and rows of views, which overlap by half, that cover the image at a zoom."""
        side = self.predictor.side
        columns, rows = (1 + max(0, math.ceil(2 * (zoom * n / side + 2 * OVERHANG - 1))) for n in picture.size)
        return columns, rows

    def _proposed(self, picture: Image.Image, zoom: float) -> list[_Region]:
        """The largest region of each view at a zoom. Its score is minus the spread of the object's place."""
        side, (columns, rows) = self.predictor.side, self._counts(picture, zoom)
        edge, width, height = round(OVERHANG * side), *(max(1, round(zoom * n)) for n in picture.size)
        canvas = Image.new("RGB", ((columns + 1) * side // 2, (rows + 1) * side // 2), (GREY, GREY, GREY))
        resampling = Image.Resampling.BOX if zoom < 1 else Image.Resampling.BILINEAR
        canvas.paste(picture.resize((width, height), resampling), (edge, edge))
        pixels, unit = np.asarray(canvas), np.array(picture.size) / (width, height)
        places = [(row * side // 2, column * side // 2) for row in range(rows) for column in range(columns)]
        maps, spreads = self._maps([pixels[y : y + side, x : x + side] for y, x in places])
        found = []
        for (y, x), probability, spread in zip(places, maps.numpy(), spreads.tolist(), strict=True):
            regions = _regions(probability, FEWEST_CELLS)
            if regions:
                corners, _ = max(regions, key=lambda region: region[1].sum())
                level = corners * side / len(probability) + np.array([x, y]) - edge
                found.append((_enclosing(level * unit, picture), -spread))
        return [_Region(box, score) for box, score in found if box]

    def _maps(
        self, views: Sequence[UInt8[np.ndarray, "S S 3"]]
    ) -> tuple[Float[Tensor, "n rows columns"], Float[Tensor, " n"]]:
        """For each view the probability that a cell shows the object, and the share over which its place is spread.

        The spread is exp(entropy) over the number of cells.
        """
        predictor, maps, spreads = self.predictor, [], []
        for first in range(0, len(views), BATCH):
            batch = torch.from_numpy(np.stack(views[first : first + BATCH])).to(predictor.device)
            seen = predictor.regressor.see(batch)
            assert seen.log_odds is not None
            assert seen.log_heat is not None
            maps.append(seen.log_odds.sigmoid().cpu())
            spreads.append(torch.special.entr(seen.log_heat.exp()).sum((1, 2)).exp().cpu() / seen.log_heat[0].numel())
        return torch.cat(maps), torch.cat(spreads)

    def _seen_again(
        self, picture: Image.Image, K: Float[np.ndarray, "3 3"], lens: Lens, regions: Sequence[_Region]
    ) -> list[_Region]:
        """The regions in views of these boxes; without those that show nothing, or an unfamiliar object.

        The score is the mean probability times the overlap with the box before, less where the place is spread.
        """
        seen = [(one.box, camera) for one in regions if (camera := self._camera(K, lens, one.box))]
        if not seen:
            return []
        views = [cut(picture, camera) for _, camera in seen]
        maps, spreads = self._maps(views)
        fine = interpolate(maps[:, None], scale_factor=FINE, mode="bilinear")[:, 0].numpy()
        factors = (SPREAD / spreads).clamp_max(1).where(torch.tensor(self._usual(views, seen)), 0.0).tolist()
        found = []
        for (before, camera), probability, factor in zip(seen, fine, factors, strict=True):
            likely = []
            for corners, inside in _regions(probability, FEWEST_CELLS * FINE**2):
                tangents = (2 * corners / len(probability) - 1) * camera.S / camera.f / 2
                if box := _enclosing(camera.real_pixels(tangents), picture):
                    likely.append((overlap(before, box), float(inside.mean()), box))
            if likely and factor:
                similar, mean, box = max(likely)
                found.append(_Region(box, factor * similar * mean))
        return found

    def _usual(
        self, views: Sequence[UInt8[np.ndarray, "S S 3"]], seen: Sequence[tuple[Box, VirtualCamera]]
    ) -> Sequence[bool]:
        """Whether the predictions are familiar; of a run that cannot tell, all are."""
        f = torch.tensor([camera.f for _, camera in seen], dtype=torch.float64)
        familiar = self.predictor.familiar(self.predictor.raw(np.stack(views), f), f)
        return [True] * len(views) if familiar is None else (familiar >= LEAST_FAMILIAR).tolist()

    def _camera(self, K: Float[np.ndarray, "3 3"], lens: Lens, box: Box) -> VirtualCamera | None:
        """The camera of a view with a margin around a box, or without one where the view would be too wide."""
        side, largest_f = float(self.predictor.side), self.predictor.largest_f
        for factor in (MARGIN, 1.0):
            with suppress(ValueError):
                return VirtualCamera.of_box(K, enlarged(box, factor), side, lens, largest_f)
        return None


def _regions(
    probability: Float[np.ndarray, "n n"], fewest: int
) -> list[tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, " points"]]]:
    """The connected regions with more than 1/2: the corners (x, y) of their points, in points, and probabilities."""
    labels, n = ndimage.label(probability > 0.5)
    found = []
    for number in range(1, n + 1):
        rows, columns = np.nonzero(labels == number)
        if len(rows) >= fewest:
            corners = np.concatenate([np.stack([columns + x, rows + y], -1) for x in (0, 1) for y in (0, 1)])
            found.append((corners, probability[rows, columns]))
    return found


def _enclosing(pixels: Float[np.ndarray, "places 2"], picture: Image.Image) -> Box | None:
    """The box of places in an image; None if it has not the size of a pixel."""
    pixels = pixels[np.isfinite(pixels).all(-1)].clip(0, picture.size)
    if not len(pixels) or not (np.ptp(pixels, axis=0) >= 1).all():
        return None
    (left, top), (right, bottom) = pixels.min(0).tolist(), pixels.max(0).tolist()
    return left, top, right, bottom


def _separate(regions: Sequence[_Region]) -> list[_Region]:
    """The regions in descending order of their scores, without those largely inside an earlier one."""
    kept: list[_Region] = []
    for one in sorted(regions, key=lambda region: -region.score):
        if all(common_area(one.box, other.box) <= CONTAINED * min(area(one.box), area(other.box)) for other in kept):
            kept.append(one)
    return kept
