"""The predictor as a network of its own, from images, or from a photograph with boxes, to positions with uncertainty.

An exported graph is traced from it. The network computes in float32, everything else in float32 or float64.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn
from torch.export import Dim

from phd_exp.data.areas import area_means, sums
from phd_exp.distributions.gaussian_mixture import GaussianMixture
from phd_exp.geometry.facing import facing, pixel_corners
from phd_exp.inference.answers import PER_CENT
from phd_exp.inference.predictor import Predictor
from phd_exp.models.heads import Prediction
from phd_exp.models.trained import PIXELS
from phd_exp.optics.virtual import intrinsics
from phd_exp.records.errors import ConfigError

Precision = Literal["float32", "float64"]
"""The type of all numbers before and after the network."""
FOCAL_LENGTHS = (5.0, 9.0)  # range for the comparison with torch, in sides of the image
NUMBER = Dim("n", min=0)
PHOTOGRAPHS = ((150, 150, 1), (180, 240, 7), (301, 199, 24))  # width, height and number of boxes


class Deployed(nn.Module, ABC):
    """Abstract base class: the inputs of a graph -> the raw numbers of the network, and the answers, in float32.

    Args:
        predictor: the network or ensemble.
        precision: the type of all numbers before and after the network.
    """

    inputs: tuple[str, ...]
    dynamic_shapes: tuple[dict[int, Dim] | None, ...]
    """Of each input: the dimensions whose size is free."""

    def __init__(self, predictor: Predictor, precision: Precision = "float32") -> None:
        super().__init__()
        self.predictor, self.dtype = predictor, torch.float32 if precision == "float32" else torch.float64
        self.network = predictor.network

    @abstractmethod
    def cases(self) -> Iterator[tuple[tuple[Tensor, ...], Tensor, Prediction]]:
        """Inputs on which the graph is compared with `predict`: inputs, raw numbers, predictions in float64."""

    def answers(self, prediction: Prediction, *inputs: Tensor) -> dict[str, Tensor]:
        """The outputs after the raw numbers."""
        return answers(prediction)

    def outputs(self, is_valid: Bool[Tensor, " batch"], raw: Tensor, answers: Iterable[Tensor]) -> tuple[Tensor, ...]:
        """All outputs in float32; NaN in the rows of inputs that are not valid."""
        values = (raw, *(value.float() for value in answers))
        return tuple(torch.where(is_valid[(..., *[None] * (value.ndim - 1))], value, torch.nan) for value in values)


class OfImages(Deployed):
    """Images (batch, side, side, 3) of the network's size, with the principal point in the middle, and f (batch,)."""

    inputs = ("image", "f")
    dynamic_shapes = ({0: NUMBER}, {0: NUMBER})

    def forward(self, image: UInt8[Tensor, "batch S S 3"], f: Float[Tensor, " batch"]) -> tuple[Tensor, ...]:
        raw = self.network.outputs(image, self.network.camera(f).f)
        answers = self.answers(self.predictor.predict(raw, f, self.dtype), image, f)
        return self.outputs((f > 0) & f.isfinite(), raw, answers.values())

    def cases(self) -> Iterator[tuple[tuple[Tensor, ...], Tensor, Prediction]]:
        side = self.predictor.side
        n = sum(numbers := batches(side))
        images = torch.from_numpy(pictures(n, side, side))
        f = (side * torch.linspace(*FOCAL_LENGTHS, n)).float()
        for rows in torch.arange(n).split(numbers):
            raw = self.predictor.raw(images[rows].numpy(), f[rows])
            yield (images[rows], f[rows]), raw, self.predictor.predict(raw, f[rows])


class OfPhotographs(Deployed):
    """A photograph (height, width, 3) of any size, K (3, 3), and boxes (n, 4): left, top, right, bottom, px.

    The crops are those of `predict`, and positions are in the frame of the photograph's camera.
    """

    inputs = ("photograph", "K", "boxes")
    dynamic_shapes = ({0: Dim("height", min=1), 1: Dim("width", min=1)}, None, {0: NUMBER})

    def forward(
        self, photograph: UInt8[Tensor, "height width 3"], K: Float[Tensor, "3 3"], boxes: Float[Tensor, "boxes 4"]
    ) -> tuple[Tensor, ...]:
        lower, upper = boxes.tensor_split(2, dim=-1)
        further = (self.predictor.margin - 1) * (upper - lower) / 2
        seen = torch.cat([lower - further, upper + further], dim=-1)
        R, f = facing(K, seen, self.predictor.side, self.predictor.f_range[1])
        image = area_means(sums(photograph), *pixel_corners(K, seen, R, f, self.predictor.side))
        raw = self.network.outputs(image, self.network.camera(f.float()).f)
        answers = self.answers(self.predictor.predict(raw, f.float(), self.dtype), photograph, K, boxes)
        left, top, right, bottom = boxes.unbind(-1)
        height, width = photograph.shape[:2]
        is_inside = (left < width) & (top < height) & (right > 0) & (bottom > 0)
        is_valid = is_inside & (left < right) & (top < bottom) & f.isfinite() & (K.diagonal() > 0).all()
        return self.outputs(is_valid, raw, answers.values())

    def answers(self, prediction: Prediction, *inputs: Tensor) -> dict[str, Tensor]:
        K, boxes = (value.to(prediction.mode.dtype) for value in inputs[1:])
        R, _ = facing(K, boxes, self.predictor.side, self.predictor.f_range[1])
        here = answers(prediction)
        for name in ("mode", "mean", "position"):
            if name in here:
                here[name] = (R.mT @ here[name][..., None])[..., 0]
        if "covariance" in here:
            here["covariance"] = R.mT @ here["covariance"] @ R
            here["median_along_ray"] = here.pop("median_depth")
            here["interval_along_ray"] = here.pop("depth_interval")
        return here | {"ray": R[:, 2]}

    def cases(self) -> Iterator[tuple[tuple[Tensor, ...], Tensor, Prediction]]:
        draw, predictor = np.random.default_rng(1), self.predictor
        for width, height, n in PHOTOGRAPHS:
            (photograph,) = pictures(1, height, width)
            f = max(width, height) * draw.uniform(1, 2)
            K = torch.from_numpy(intrinsics(f, 1.1 * f, 0.45 * width, 0.55 * height)).to(self.dtype)
            middle, half = draw.uniform(0.1, 0.9, (n, 2)), draw.uniform(0.05, 0.3, (n, 2))
            ends = np.concatenate([middle - half, middle + half], axis=1) * np.tile([width, height], 2)
            boxes = torch.from_numpy(ends).to(self.dtype)
            views = [predictor.view(photograph, K.double().numpy(), tuple(box)) for box in boxes.tolist()]
            known = torch.tensor([view.camera.f for view in views], dtype=torch.float32)
            raw = predictor.raw(np.stack([view.image for view in views]), known)
            yield (torch.from_numpy(photograph), K, boxes), raw, predictor.predict(raw.double(), known.double())


def require_exportable(predictor: Predictor) -> None:
    """Raise ConfigError for a density whose answers are no graph."""
    if predictor.network.head.prediction is GaussianMixture:
        raise ConfigError(
            f"{predictor.config.model.name}: cannot be exported, because the mode of a mixture of Gaussians needs "
            "inverse matrices, which ONNX lacks; expected a run of another model"
        )


def batches(side: int) -> list[int]:
    """The number of images in each batch of the comparison with torch, fewer for large images.

    Examples:
        >>> batches(224), batches(4096)
        ([1, 7, 56], [1])
    """
    return [n for n in (1, 7, 56) if n == 1 or n * side**2 <= PIXELS]


def answers(prediction: Prediction) -> dict[str, Tensor]:
    """The answers for a batch of predictions, in the frame of their cameras."""
    if not prediction.has_closed_forms:
        return {"position": prediction.mode}
    tails = torch.tensor([(1 - level / 100) / 2 for level in PER_CENT], dtype=prediction.mode.dtype)
    p = torch.cat([tails.new_tensor([0.5]), tails, 1 - tails])
    z = prediction.depth_icdf(p[:, None])  # all at once, for a small graph
    return {
        "mode": prediction.mode,
        "mean": prediction.mean,
        "covariance": prediction.covariance_matrix,
        "a": prediction.a,
        "median_depth": z[0],
        "depth_interval": torch.stack([z[1 : 1 + len(PER_CENT)], z[1 + len(PER_CENT) :]]).permute(2, 1, 0),
    }


def pictures(n: int, height: int, width: int) -> UInt8[np.ndarray, "n height width 3"]:
    """Images with shapes large and small, the same every time: coarse noise enlarged, and fine noise over it."""
    draw = np.random.default_rng(0)
    coarse = draw.integers(0, 256, (n, 8, 8, 3)).repeat(-(-height // 8), axis=1).repeat(-(-width // 8), axis=2)
    fine = draw.normal(0, 12, (n, height, width, 3))
    return (coarse[:, :height, :width] + fine).clip(0, 255).astype(np.uint8)
