"""The one LightningModule: every model of the tables trains through it."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from lightning import LightningModule
from torch import Tensor, nn

from phd_exp.data.batches import Batch
from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import Columns, calibration_columns
from phd_exp.geometry.camera import Camera
from phd_exp.metrics.binned import Calibration
from phd_exp.metrics.means import Means
from phd_exp.models.heads import Prediction
from phd_exp.models.regressor import Regressor
from phd_exp.records.errors import RunError
from phd_exp.training.predictions import columns, quantities, quantity_names


class PositionModule(LightningModule):
    """Image and camera -> prediction -> loss; metrics of both splits, logged once an epoch.

    Args:
        regressor: image and camera -> prediction.
        loss: prediction and true position -> scalar.
        optimizer: parameters -> optimizer.
        constant_f: the focal length that the model is told for every sample, in pixels; None tells it the true one.
    """

    def __init__(
        self,
        regressor: Regressor,
        loss: nn.Module,
        optimizer: Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer],
        constant_f: float | None,
    ) -> None:
        super().__init__()
        self.regressor = regressor
        self.loss = loss
        self.make_optimizer = optimizer
        self.constant_f = constant_f
        names = ("loss", *quantity_names(regressor.head.prediction))
        # "train" itself is taken: every module has a method of that name
        self.means = nn.ModuleDict({f"{split}_means": Means(names) for split in ("train", "test")})
        is_distribution = issubclass(regressor.head.prediction, ProjectedHuber)
        self.calibration = Calibration() if is_distribution else None

    def forward(self, batch: Batch) -> Prediction:
        return self.regressor(batch.image, self.told(batch.camera))

    def told(self, camera: Camera) -> Camera:
        """The camera as the model knows it."""
        if self.constant_f is None:
            return camera
        return Camera(torch.full_like(camera.f, self.constant_f), camera.S)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        return self._step(batch, "train")[0]

    def validation_step(self, batch: Batch, batch_idx: int) -> Prediction:  # type: ignore[override]  # for callbacks
        prediction = self._step(batch, "test")[1]
        if self.calibration is not None and isinstance(prediction, ProjectedHuber):
            self.calibration.update(calibration_columns(prediction, batch.xyz))
        return prediction

    def predict_step(self, batch: Batch, batch_idx: int) -> Columns:
        return columns(self(batch), batch)

    def on_train_epoch_end(self) -> None:
        self._log_epoch("train")

    def on_validation_epoch_end(self) -> None:
        self._log_epoch("test")
        if self.calibration is not None:
            scores = self.calibration.compute()
            self.log_dict({f"test/calibration/{name}": score.float() for name, score in scores.items()})
            self.calibration.reset()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return self.make_optimizer(self.regressor.parameters())

    def _step(self, batch: Batch, split: str) -> tuple[Tensor, Prediction]:
        prediction = self(batch)
        loss = self.loss(prediction, batch.xyz)
        if not loss.isfinite():
            raise RunError(
                f"loss is {loss.item()} in epoch {self.current_epoch}, at {split} samples {batch.row.tolist()}; "
                "the last checkpoint is whole: lower optimizer.lr, or look at these images"
            )
        with torch.no_grad():
            losses = {"loss": loss.expand(len(batch))}
            self._means(split).update(losses | quantities(prediction, batch.xyz))
        return loss, prediction

    def _means(self, split: str) -> Any:
        return self.means[f"{split}_means"]

    def _log_epoch(self, split: str) -> None:
        means = self._means(split)
        self.log_dict({f"{split}/{name}": value.float() for name, value in means.compute().items()})
        means.reset()
