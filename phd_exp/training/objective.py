"""What a training minimises, and the schedule of its learning rate."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from phd_exp.data.batches import Batch
from phd_exp.distributions import Density
from phd_exp.geometry.charts import projected
from phd_exp.losses import MeanAbsoluteError, NegativeLogLikelihood
from phd_exp.losses.locating import localisation_loss, segmentation_loss
from phd_exp.models.backbones import BackboneOutput
from phd_exp.models.heads import Prediction

Loss = Callable[[Prediction, Tensor], Tensor]
"""Predictions and true positions (batch, 3) -> one number per sample, or their mean."""


@dataclass(frozen=True)
class Objective:
    """The mean loss, and the weighted losses of the backbone's maps.

    Attributes:
        loss: of the predictions.
        localisation: weight of the localisation loss; 0 for a backbone that does not locate the object.
        segmentation: weight of the segmentation loss; 0 for a backbone that does not segment the object.
    """

    loss: Loss
    localisation: float = 0.0
    segmentation: float = 0.0

    def total(self, losses: Tensor, output: BackboneOutput, batch: Batch) -> Float[Tensor, ""]:
        """The number to minimise, given the losses of the predictions."""
        total = losses.mean()
        if self.localisation and output.log_heat is not None:
            place = projected(batch.xyz, batch.camera)
            total = total + self.localisation * localisation_loss(output.log_heat, place)
        if self.segmentation and output.log_odds is not None and batch.mask is not None:
            total = total + self.segmentation * segmentation_loss(output.log_odds, batch.mask, batch.mask_weight)
        return total


def natural_loss(prediction: type) -> Loss:
    """The negative log likelihood of a density, the mean absolute error of a point estimate."""
    return NegativeLogLikelihood() if issubclass(prediction, Density) else MeanAbsoluteError()


def factor(schedule: str, warmup_steps: int, steps: int) -> Callable[[int], float]:
    """Step -> factor of the optimizer's learning rate, in a run of `steps` steps.

    It rises linearly over the first `warmup_steps`. Then "constant" stays; "cosine" falls to zero as half a wave.

    Examples:
        >>> at = factor("cosine", warmup_steps=1, steps=100)
        >>> [round(at(step), 3) for step in (0, 50, 100)]
        [0.5, 0.5, 0.0]
    """

    def at(step: int) -> float:
        rise = min(1.0, (step + 1) / (warmup_steps + 1))
        fall = (1 + math.cos(math.pi * min(step / steps, 1.0))) / 2 if schedule == "cosine" else 1.0
        return rise * fall

    return at
