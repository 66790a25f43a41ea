"""The LightningModule with which all models are trained."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_, clip_grad_value_
from torch.optim.lr_scheduler import LambdaLR

from phd_exp.data.batches import Batch
from phd_exp.distributions import Density
from phd_exp.distributions.columns import Columns
from phd_exp.geometry.camera import Camera
from phd_exp.geometry.charts import projected
from phd_exp.losses import MeanAbsoluteError, NegativeLogLikelihood
from phd_exp.metrics.rows import Rows
from phd_exp.models.heads import Prediction
from phd_exp.models.locating import localisation_loss, segmentation_loss
from phd_exp.models.regressor import Regressor
from phd_exp.records.errors import RunError, listed
from phd_exp.training.network import f_factor
from phd_exp.training.predictions import columns, summary, training_columns


class PositionModule(LightningModule):
    """Image and camera -> prediction -> loss, with the metrics of both splits logged once per epoch.

    Training runs in the precision of the Trainer. The network is always evaluated in float32, so that logged metrics,
    recorded predictions, `predict` and an exported network agree.

    Args:
        regressor: image and camera -> prediction.
        loss: prediction and true positions -> one number per sample, or their mean; None: negative log likelihood for
            a density, mean absolute error for a point estimate.
        optimizer: parameters -> optimizer.
        constant_f: focal length in pixels that the model uses for every sample; None: the true one.
        f_error: standard deviation of the relative error of the focal lengths that the model uses.
        localisation: weight of the localisation loss; 0 for a backbone that does not locate the object.
        segmentation: weight of the segmentation loss; 0 for a backbone that does not segment the object.
        schedule: number of steps -> factor of the learning rate at each; see `factor`.

    Attributes:
        table: the rows of the last evaluation, see `training.predictions.columns`.
    """

    def __init__(
        self,
        regressor: Regressor,
        loss: Callable[[Prediction, Tensor], Tensor] | None = None,
        optimizer: Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer] = torch.optim.Adam,
        constant_f: float | None = None,
        localisation: float = 0.0,
        schedule: Callable[[int], Callable[[int], float]] = lambda steps: lambda step: 1.0,
        f_error: float = 0.0,
        segmentation: float = 0.0,
    ) -> None:
        super().__init__()
        self.regressor = regressor
        is_density = issubclass(regressor.head.prediction, Density)
        self.loss = loss or (NegativeLogLikelihood() if is_density else MeanAbsoluteError())
        self.make_optimizer = optimizer
        self.constant_f = constant_f
        self.localisation = localisation
        self.schedule = schedule
        self.f_error = f_error
        self.segmentation = segmentation
        self.training_rows, self.evaluation_rows, self.held_out_rows = Rows(), Rows(), Rows()
        self.table: Columns = {}

    def forward(self, batch: Batch) -> Prediction:
        return self.regressor(batch.image, self.camera(batch))

    def camera(self, batch: Batch) -> Camera:
        """The cameras of a batch as the model knows them."""
        camera = batch.camera.with_constant_f(self.constant_f)
        return Camera(camera.f * self._f_factor(batch), camera.S) if self.f_error else camera

    def _f_factor(self, batch: Batch) -> Tensor:
        return f_factor(batch.row, self.f_error, self.current_epoch if self.training else 0)

    def configure_optimizers(self) -> OptimizerLRScheduler:
        optimizer = self.make_optimizer(self.regressor.parameters())
        scheduler = LambdaLR(optimizer, self.schedule(int(self.trainer.estimated_stepping_batches)))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def configure_gradient_clipping(
        self, optimizer: Any, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        # not Lightning's, which refuses fused optimizers for the sake of a scaler that bfloat16 does not need
        if gradient_clip_val:
            clip = clip_grad_value_ if gradient_clip_algorithm == "value" else clip_grad_norm_
            clip(self.parameters(), gradient_clip_val)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        output = self.regressor.see(batch.image)
        prediction = self.regressor.prediction(output, self.camera(batch))
        losses = self.loss(prediction, batch.xyz)
        total = losses.mean()
        if self.localisation and output.log_heat is not None:
            place = projected(batch.xyz, batch.camera)
            total = total + self.localisation * localisation_loss(output.log_heat, place)
        if self.segmentation and output.log_odds is not None and batch.mask is not None:
            total = total + self.segmentation * segmentation_loss(output.log_odds, batch.mask)
        self._require_finite(total, losses, batch, "train")
        with torch.no_grad():
            nll = losses if isinstance(self.loss, NegativeLogLikelihood) else None
            table = training_columns(prediction, batch.xyz, nll)
            self.training_rows.update({"loss": losses.expand(len(batch))} | table)
        return total

    def on_train_epoch_end(self) -> None:
        table = self.training_rows.columns()
        self.training_rows.reset()
        self.log_dict({f"train/{name}": column.mean().float() for name, column in table.items()})

    def validation_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        part, rows = (("test", self.evaluation_rows), ("held_out", self.held_out_rows))[dataloader_idx]
        _, losses = self._predict(batch, rows)
        self._require_finite(losses.mean(), losses, batch, part)

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        self._predict(batch, self.evaluation_rows)

    def predict_step(self, batch: Batch, batch_idx: int) -> Prediction:
        return self._predict(batch, self.evaluation_rows)[0]

    def on_validation_epoch_end(self) -> None:
        for part, rows in (("held_out", self.held_out_rows), ("test", self.evaluation_rows)):
            if rows.update_called:
                self._finish_evaluation(rows)
                self.log_dict({name: torch.tensor(value) for name, value in summary(self.table, part).items()})

    on_test_epoch_end = on_validation_epoch_end

    def on_predict_epoch_end(self) -> None:
        self._finish_evaluation(self.evaluation_rows)

    def _predict(self, batch: Batch, rows: Rows) -> tuple[Prediction, Tensor]:
        """Predict a batch without autocast and record its rows; returns the predictions and their losses."""
        with torch.autocast(self.device.type, enabled=False):
            prediction = self(batch)
            losses = self.loss(prediction, batch.xyz)
        rows.update(columns(prediction, batch, self._f_factor(batch)) | {"loss": losses.expand(len(batch))})
        return prediction, losses

    def _finish_evaluation(self, rows: Rows) -> None:
        self.table = rows.columns()
        rows.reset()

    def _require_finite(self, total: Tensor, losses: Tensor, batch: Batch, split: str) -> None:
        """Raise RunError naming the samples whose loss is not finite, or all if only the total is not."""
        if total.isfinite():
            return
        is_bad = ~losses.detach().expand(len(batch)).isfinite()
        rows = batch.row[is_bad if is_bad.any() else slice(None)].tolist()
        data = getattr(self.trainer, "datamodule", None)
        names = data.source.known(split).get("file_name") if data else None
        raise RunError(
            f"loss is {total.item()} in epoch {self.current_epoch + 1}/{self.trainer.max_epochs}, at {split} samples "
            f"{listed([names[row] if names else str(row) for row in rows])}; the last checkpoint is whole: lower "
            "optimizer.lr, or look at these images"
        )


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
