"""The one LightningModule: every model of the tables trains through it."""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from lightning import LightningModule
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from phd_exp.data.batches import Batch
from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.columns import Columns, calibration_columns
from phd_exp.geometry.camera import Camera
from phd_exp.geometry.charts import projected
from phd_exp.losses.localisation import localisation_loss
from phd_exp.metrics.binned import Calibration
from phd_exp.metrics.means import Means
from phd_exp.models.heads import Prediction
from phd_exp.models.regressor import Regressor
from phd_exp.records.errors import RunError, listed
from phd_exp.training.predictions import columns, quantities, quantity_names


class PositionModule(LightningModule):
    """Image and camera -> prediction -> loss; metrics of both splits, logged once an epoch.

    Args:
        regressor: image and camera -> prediction.
        loss: prediction and true position -> scalar.
        optimizer: parameters -> optimizer.
        constant_f: the focal length that the model is told for every sample, in pixels; None tells it the true one.
        localisation: weight of the localisation loss; above 0 only with a backbone that locates.
        schedule: number of steps -> factor of the learning rate at each; see `schedule.factor`.
    """

    def __init__(
        self,
        regressor: Regressor,
        loss: nn.Module,
        optimizer: Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer],
        constant_f: float | None,
        localisation: float,
        schedule: Callable[[int], Callable[[int], float]],
    ) -> None:
        super().__init__()
        self.regressor = regressor
        self.loss = loss
        self.make_optimizer = optimizer
        self.constant_f = constant_f
        self.localisation = localisation
        self.schedule = schedule
        names = ("loss", *quantity_names(regressor.head.prediction))
        # "train" itself is taken: every module has a method of that name
        self.means = nn.ModuleDict({f"{split}_means": Means(names) for split in ("train", "test")})
        is_distribution = issubclass(regressor.head.prediction, ProjectedHuber)
        self.calibration = Calibration() if is_distribution else None

    def forward(self, batch: Batch) -> Prediction:
        return self.regressor(batch.image, self.told(batch.camera))

    def told(self, camera: Camera) -> Camera:
        """The camera as the model knows it."""
        return camera.with_constant_f(self.constant_f)

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

    def configure_optimizers(self) -> OptimizerLRScheduler:
        optimizer = self.make_optimizer(self.regressor.parameters())
        scheduler = LambdaLR(optimizer, self.schedule(int(self.trainer.estimated_stepping_batches)))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def _step(self, batch: Batch, split: str) -> tuple[Tensor, Prediction]:
        """The loss to descend on and the prediction; what is recorded as `loss` is the model's own alone."""
        seen = self.regressor.see(batch.image)
        prediction = self.regressor.prediction(seen, self.told(batch.camera))
        loss = total = self.loss(prediction, batch.xyz)
        if split == "train" and self.localisation and seen.log_heat is not None:
            total = total + self.localisation * localisation_loss(
                seen.log_heat, projected(batch.xyz, batch.camera)
            )
        if not total.isfinite():
            raise self._not_finite(total, prediction, batch, split)
        with torch.no_grad():
            losses = {"loss": loss.expand(len(batch))}
            self._means(split).update(losses | quantities(prediction, batch.xyz))
        return total, prediction

    def _not_finite(self, total: Tensor, prediction: Prediction, batch: Batch, split: str) -> RunError:
        """What to say of a loss: whose numbers are not finite, or all samples where their sum alone is not."""
        values = torch.stack(list(quantities(prediction, batch.xyz).values()))
        is_bad = ~values.isfinite().all(dim=0)
        rows = batch.row[is_bad if is_bad.any() else slice(None)].tolist()
        files = self.trainer.datamodule.source.known(split)["file_name"]  # type: ignore[attr-defined]
        return RunError(
            f"loss is {total.item()} in epoch {self.current_epoch + 1}/{self.trainer.max_epochs}, at {split} samples "
            f"{listed([files[row] for row in rows])}; the last checkpoint is whole: lower optimizer.lr, or look at "
            "these images"
        )

    def _means(self, split: str) -> Any:
        return self.means[f"{split}_means"]

    def _log_epoch(self, split: str) -> None:
        means = self._means(split)
        self.log_dict({f"{split}/{name}": value.float() for name, value in means.compute().items()})
        means.reset()
