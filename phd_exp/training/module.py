"""The LightningModule with which all models are trained."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
import torch.distributed as dist
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_, clip_grad_value_
from torch.optim.lr_scheduler import LambdaLR

from phd_exp.data.batches import Batch
from phd_exp.losses import NegativeLogLikelihood
from phd_exp.metrics.rows import Rows
from phd_exp.models.heads import Prediction
from phd_exp.models.regressor import Regressor
from phd_exp.records.errors import RunError, listed
from phd_exp.training.cameras import CameraPolicy, f_factor
from phd_exp.training.objective import Objective, natural_loss
from phd_exp.training.predictions import columns, summary, training_columns

UNREAD = 50  # steps whose losses are read together


class PositionModule(LightningModule):
    """Image and camera -> prediction -> loss, with the metrics of both splits logged once per epoch.

    Training runs in the precision of the Trainer. The network is always evaluated in float32, so that logged metrics,
    recorded predictions, `predict` and an exported network agree.

    Args:
        regressor: image and camera -> prediction.
        objective: what training minimises; None: the `natural_loss` of the predictions.
        camera: the cameras that the model receives.
        optimizer: parameters -> optimizer.
        schedule: number of steps -> factor of the learning rate at each; see `factor`. None: it is constant.

    Attributes:
        evaluation_rows: rows of the test samples of an evaluation, see `training.predictions.columns`.
    """

    def __init__(
        self,
        regressor: Regressor,
        objective: Objective | None = None,
        camera: CameraPolicy | None = None,
        optimizer: Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer] = torch.optim.Adam,
        schedule: Callable[[int], Callable[[int], float]] | None = None,
    ) -> None:
        super().__init__()
        self.regressor = regressor
        self.objective = objective or Objective(natural_loss(regressor.head.prediction))
        self.loss = self.objective.loss  # a module among others, whose buffers move to the GPU
        self.camera = camera or CameraPolicy()
        self.optimizer = optimizer
        self.schedule = schedule or (lambda steps: lambda step: 1.0)
        self.training_rows, self.evaluation_rows, self.held_out_rows = Rows(), Rows(), Rows()
        self.unread: list[tuple[str, Tensor, Tensor, Tensor]] = []

    def forward(self, batch: Batch) -> Prediction:
        return self.regressor(batch.image, self.camera(batch))

    def configure_optimizers(self) -> OptimizerLRScheduler:
        optimizer = self.optimizer(self.regressor.parameters())
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
        try:
            output = self.regressor.see(batch.image)
            prediction, trained = self.regressor.trained(output, self.camera(batch, self.current_epoch))
            losses = self.loss(trained, batch.xyz)
            total = self.objective.total(losses, output, batch)
        except Exception:  # a part may refuse the numbers of a network that an earlier loss has broken
            self.require_finite()
            raise
        self._note(total, losses, batch, "train")
        with torch.no_grad():
            nll = losses if isinstance(self.loss, NegativeLogLikelihood) and trained is prediction else None
            table = training_columns(prediction, batch.xyz, nll)
            self.training_rows.update({"loss": losses.expand(len(batch))} | table)
        return total

    def on_train_epoch_end(self) -> None:
        self.require_finite()
        table = self.training_rows.columns()
        self.training_rows.reset()
        self.log_dict({f"train/{name}": column.mean().float() for name, column in table.items()})

    def on_validation_epoch_start(self) -> None:
        self.require_finite()  # before a broken network is evaluated
        self.evaluation_rows.reset()

    def validation_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        part, rows = (("test", self.evaluation_rows), ("held_out", self.held_out_rows))[dataloader_idx]
        _, losses = self._predict(batch, rows)
        self._note(losses.mean(), losses, batch, part)

    def on_validation_epoch_end(self) -> None:
        self.require_finite()
        for part, rows in (("held_out", self.held_out_rows), ("test", self.evaluation_rows)):
            if rows.update_called:
                scores = summary(rows.columns(), part)
                self.log_dict({name: torch.tensor(value) for name, value in scores.items()})
                rows.reset()

    on_test_epoch_end = on_validation_epoch_end

    def test_step(self, batch: Batch, batch_idx: int) -> None:
        self._predict(batch, self.evaluation_rows)

    def on_predict_epoch_start(self) -> None:
        self.evaluation_rows.reset()

    def predict_step(self, batch: Batch, batch_idx: int) -> Prediction:
        return self._predict(batch, self.evaluation_rows)[0]

    def _predict(self, batch: Batch, rows: Rows) -> tuple[Prediction, Tensor]:
        """Predict a batch without autocast and add its rows; returns the predictions and their losses."""
        with torch.autocast(self.device.type, enabled=False):
            prediction = self(batch)
            losses = self.loss(prediction, batch.xyz)
        factor = f_factor(batch.row, self.camera.f_error)
        rows.update(columns(prediction, batch, factor) | {"loss": losses.expand(len(batch))})
        return prediction, losses

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.require_finite()

    def _note(self, total: Tensor, losses: Tensor, batch: Batch, part: str) -> None:
        """Keep the losses of a step until they are read: a GPU would wait for a read in each step."""
        self.unread.append((part, total.detach(), losses.detach().expand(len(batch)), batch.row))
        # several processes share gradients, so that a broken loss would be found by the wrong one
        if len(self.unread) == UNREAD or dist.is_initialized():
            self.require_finite()

    def require_finite(self) -> None:
        """Raise RunError naming the samples of the first loss that is not finite, or the batch if only its total is
        not.
        """
        unread, self.unread = self.unread, []
        if not unread or bool(torch.stack([total for _, total, *_ in unread]).isfinite().all()):
            return
        part, total, losses, row = next(one for one in unread if not one[1].isfinite())
        is_bad = ~losses.isfinite()
        rows = row[is_bad if is_bad.any() else slice(None)].tolist()
        data = getattr(self.trainer, "datamodule", None)
        names = data.source.known(part).get("file_name") if data else None
        raise RunError(
            f"loss is {total.item()} in epoch {self.current_epoch + 1}/{self.trainer.max_epochs}, at {part} samples "
            f"{listed([names[row] if names else str(row) for row in rows])}; the last checkpoint is whole: lower "
            "optimizer.lr, or look at these images"
        )
