"""The cameras that a model receives, which may have wrong or constant focal lengths."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from phd_exp.data.batches import Batch
from phd_exp.geometry.camera import Camera

GOLDEN = (math.sqrt(5) - 1) / 2


@dataclass(frozen=True)
class CameraPolicy:
    """The true cameras of a batch -> those that the model receives.

    Attributes:
        constant_f: focal length in pixels of every sample; None: the true one.
        f_error: standard deviation of the relative error of the focal lengths.
    """

    constant_f: float | None = None
    f_error: float = 0.0

    def __call__(self, batch: Batch, epoch: int = 0) -> Camera:
        camera = batch.camera.with_constant_f(self.constant_f)
        factor = f_factor(batch.row, self.f_error, epoch) if self.f_error else 1.0
        return Camera.unchecked(camera.f * factor, camera.S)


def f_factor(row: Int[Tensor, " batch"], f_error: float, epoch: int = 0) -> Float[Tensor, " batch"]:
    """Focal length that the model receives relative to the true one: exp(f_error e), with the `standard_error` e.

    Evaluations have the errors of epoch 0, so that every record of a sample has the same.
    """
    return (f_error * standard_error(row, epoch)).exp()


def standard_error(row: Int[Tensor, " batch"], epoch: int) -> Float[Tensor, " batch"]:
    """A standard normal number for each sample and epoch, evenly spread over samples and over epochs.

    It depends on (row, epoch) alone, so a resumed or distributed run trains on the same numbers.

    Source: multiples of irrational numbers modulo 1 are evenly distributed (Weyl); checked in
    tests/training/test_f_error.py.
    """
    place = row.double() * GOLDEN + epoch * math.sqrt(2)
    return torch.special.ndtri(place.frac().clamp(1e-6, 1 - 1e-6)).float()
