"""The one LightningModule: every model of the tables trains through it."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from lightning import LightningModule
from torch import Tensor, nn
from torchmetrics import MeanMetric, Metric

from phd_exp.data.batches import Batch
from phd_exp.distributions import ProjectedHuber
from phd_exp.geometry.camera import Camera
from phd_exp.metrics.errors import PositionErrors
from phd_exp.metrics.precision import Precision
from phd_exp.models.heads import Prediction
from phd_exp.models.regressor import Regressor
from phd_exp.records.errors import RunError
from phd_exp.training.predictions import Columns, columns


class EpochMetrics(nn.Module):
    """What one split logs for an epoch: loss, errors and, for a distribution, NLL and precision."""

    def __init__(self, prediction: type[Prediction]) -> None:
        super().__init__()
        self.loss = MeanMetric()
        self.errors = PositionErrors()
        self.is_distribution = issubclass(prediction, ProjectedHuber)
        if self.is_distribution:
            self.nll = MeanMetric()
            self.precision = Precision()

    @torch.no_grad()
    def update(self, loss: Tensor, prediction: Prediction, xyz: Tensor) -> None:
        self.loss.update(loss, weight=len(xyz))
        self.errors.update(xyz, prediction.mode)
        if isinstance(prediction, ProjectedHuber):
            self.nll.update(-prediction.log_prob(xyz))
            self.precision.update(prediction.a, prediction.log_det_A)

    def compute(self) -> dict[str, Tensor]:
        values = {"loss": self.loss.compute()} | self.errors.compute()
        if self.is_distribution:
            values |= {"nll": self.nll.compute()} | self.precision.compute()
        return values

    def reset(self) -> None:
        for metric in self.children():
            assert isinstance(metric, Metric)
            metric.reset()


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
        self.epoch_metrics = nn.ModuleDict(
            {f"{split}_metrics": EpochMetrics(regressor.head.prediction) for split in ("train", "test")}
        )

    @property
    def predicts_distribution(self) -> bool:
        return issubclass(self.regressor.head.prediction, ProjectedHuber)

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
        return self._step(batch, "test")[1]

    def predict_step(self, batch: Batch, batch_idx: int) -> Columns:
        return columns(self(batch), batch)

    def on_train_epoch_end(self) -> None:
        self._log_epoch("train")

    def on_validation_epoch_end(self) -> None:
        self._log_epoch("test")

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
        self._metrics(split).update(loss.detach(), prediction, batch.xyz)
        return loss, prediction

    def _metrics(self, split: str) -> Any:
        return self.epoch_metrics[f"{split}_metrics"]

    def _log_epoch(self, split: str) -> None:
        metrics = self._metrics(split)
        self.log_dict({f"{split}/{name}": value.float() for name, value in metrics.compute().items()})
        metrics.reset()
