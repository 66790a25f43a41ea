"""The ranges of a run's training, and the warnings about views and predictions beyond them."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from phd_exp.config import RenderedConfig, RunConfig
from phd_exp.optics.virtual import Box, VirtualCamera

Range = tuple[float, float]

ANY = (0.0, math.inf)
FEWEST = 20  # held-out samples that show a range
BEYOND = 1.1  # factor beyond the extremes of held-out samples, which training exceeds, and for errors of predictions
FAR = 1.2  # factor beyond the focal lengths of the training from which on nothing is predicted
OUTSIDE = 0.1  # of half the box: predictions of positions at an edge of the training err


@dataclass(frozen=True)
class Ranges:
    """What a network was trained with; `ANY` where that is unknown.

    Args:
        focal_length: of the views, px of the network's image.
        distance: of the object along the axis of the view, m.
        box_size: side of the view at that distance, m; implied by the others for whole images.
        edge: least distance of the position from the edges of the photograph, in halves of the box.
        is_exact: whether the focal lengths are those of the configuration, or of held-out samples.
    """

    focal_length: Range = ANY
    distance: Range = ANY
    box_size: Range = ANY
    edge: float = -math.inf
    is_exact: bool = True

    @classmethod
    def of(cls, config: RunConfig, side: int, f_range: Range, file: Path) -> "Ranges":
        """Those of a run: of rendered whole images, what was drawn from; otherwise, of held-out samples in a file.

        `f_range` and `side` are those of the `Predictor`, px.
        """
        data, zoom = config.data, config.recipe.augmentation.largest_zoom
        spec = data.spec if isinstance(data, RenderedConfig) else None
        if spec and not spec.is_box:
            (low, high), distance = f_range, spec.z_range if spec.views == 1 else ANY
            return cls((low / zoom, high * zoom), distance, edge=0.0)
        edge = spec.edge_distance / spec.box_size[1] if spec and spec.edge_distance >= 0 else -math.inf
        if not file.exists():
            return cls(edge=edge)
        from phd_exp.evaluation.parquet import read_table, require_columns  # imports pyarrow

        table = read_table(file)
        require_columns(("f", "S", "z"), table)
        f, z = table["f"] / table["S"] * side, table["z"]
        if len(z) < FEWEST:
            return cls(edge=edge)
        (low, high), distance, box_size = ((float(x.min()), float(x.max())) for x in (f, z, side * z / f))
        return cls((low / zoom, high * zoom), distance, box_size, edge, is_exact=False)

    def refusal(self, camera: VirtualCamera) -> str | None:
        """Why nothing is predicted from a view: its focal length is more than a fifth beyond the training."""
        if fault := self._focal_length(camera, FAR):
            fault += "; expected box= or boxes= around the object, or beyond=true to predict anyway"
        return fault

    def of_view(self, camera: VirtualCamera) -> str | None:
        """The warning about the focal length of a view; None if it is like those of the training."""
        return self._focal_length(camera, 1.001 if self.is_exact else BEYOND)

    def warnings(
        self,
        camera: VirtualCamera,
        mode: Float[np.ndarray, "3"],
        box: Box,
        size: tuple[int, int],
        familiar: float | None,
    ) -> list[str]:
        """What is beyond the training, each with its name before a colon.

        Args:
            camera: of the view.
            mode: the most likely position in its frame, m.
            box: the part of the photograph that is predicted from, px.
            size: width and height of the photograph, px.
            familiar: the p-value of the prediction, see `Predictor.familiar`.
        """
        z, found = float(mode[2]), []
        if fault := self.of_view(camera):
            found.append(fault)
        if not _contains(self.distance, z, BEYOND):
            found.append(f"distance: {z:.4g} m; {_trained(self.distance)} m")
        if not _contains(self.box_size, width := z * camera.S / camera.f, BEYOND):
            found.append(f"box_size: {width:.4g} m at the predicted distance; {_trained(self.box_size)} m")
        half = max(box[2] - box[0], box[3] - box[1]) / 2
        place = camera.real_pixels(mode[:2] / mode[2])
        edge = float(np.minimum(place, size - place).min()) / half
        if self.edge > -math.inf and not edge >= self.edge - OUTSIDE:  # NaN beyond the field of a lens, too
            found.append(
                f"cut_off: {edge:.2f} half boxes from the edge of the image to the position; trained with at least "
                f"{self.edge:.2f}"
            )
        if familiar is not None:
            from phd_exp.evaluation.familiar import ALARM  # imports pyarrow

            if familiar < ALARM:
                found.append(f"unfamiliar: {familiar:.4g}; {100 * ALARM:g} % of held-out samples are below {ALARM:g}")
        return found

    def _focal_length(self, camera: VirtualCamera, factor: float) -> str | None:
        if _contains(self.focal_length, camera.f, factor):
            return None
        px = f"{camera.f:.4g} px in the network's image of {camera.S:g} px"
        return f"focal_length: {px}; {_trained(self.focal_length)} px"


UNKNOWN = Ranges()


def _contains(bounds: Range, value: float, factor: float) -> bool:
    """Whether a value lies between the bounds, moved outwards by a factor."""
    return bounds == ANY or bounds[0] / factor <= value <= bounds[1] * factor


def _trained(bounds: Range) -> str:
    return f"trained with {bounds[0]:.4g} to {bounds[1]:.4g}"
