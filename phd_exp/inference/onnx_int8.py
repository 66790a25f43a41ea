"""The network of a graph in int8, and what that costs on held-out images."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from jaxtyping import Float
from onnxruntime import quantization
from torch import Tensor

from phd_exp.data.batches import Batch
from phd_exp.distributions.density import Density
from phd_exp.inference.deployed import Deployed
from phd_exp.metrics.errors import MILLIMETRES, depth_error
from phd_exp.records.errors import ConfigError, UserError
from phd_exp.records.runs import CHOOSE, GUARANTEE

MOST_DEPTH_ERROR, MOST_NLL = 3.0, 0.1  # per cent and nats that int8 may add
CALIBRATION = 256  # held-out images at most whose activations give the ranges of int8
AT_THE_END = 2  # last convolutions that stay exact: they give the object's place, which int8 would round to a cell
IMAGES_AT_LEAST = 40  # below, a change of the errors is mostly noise
INSIDE = 0.9  # level of the regions whose share of true positions is compared


@dataclass(frozen=True)
class Change:
    """Mean errors of held-out images in float32, and in int8; NLL and coverage are None for a baseline."""

    images: int
    depth_error_mm: tuple[float, float]
    nll: tuple[float, float] | None
    inside_90: tuple[float, float] | None

    @property
    def depth_error_per_cent(self) -> float:
        """The change of the depth error, per cent."""
        before, after = self.depth_error_mm
        return 100 * (after / before - 1)

    def __str__(self) -> str:
        before, after = self.depth_error_mm
        text = f"depth error {before:.2f} -> {after:.2f} mm ({self.depth_error_per_cent:+.1f} %)"
        if self.nll and self.inside_90:
            text += f", NLL {self.nll[0]:.3f} -> {self.nll[1]:.3f} nats, "
            text += f"inside 90 % {100 * self.inside_90[0]:.1f} -> {100 * self.inside_90[1]:.1f} %"
        return f"{text} on {self.images} held-out images"

    def require_small(self, file: Path) -> None:
        """Raise UserError if int8 loses too much."""
        more = self.nll[1] - self.nll[0] if self.nll else 0.0
        if not (self.depth_error_per_cent <= MOST_DEPTH_ERROR and more <= MOST_NLL):
            raise UserError(
                f"{file}: not written: quantize=int8 costs too much: {self}; at most {MOST_DEPTH_ERROR:g} % and "
                f"{MOST_NLL:g} nats more; leave quantize= out"
            )


def quantized(model: Any, deployed: Deployed, held_out: Batch) -> Any:
    """The graph with convolutions in int8, calibrated on every second held-out image.

    Weights have a scale for each channel, activations one for each tensor; all zero points are 0, as TensorRT wants.
    The first convolution, the last `AT_THE_END` and all other operations stay as they are.

    Raises ConfigError if no other convolution is left.
    """
    names = [node.name for node in model.graph.node if node.op_type == "Conv"]
    if len(names) <= 1 + AT_THE_END:
        raise ConfigError(
            f"quantize: got a network with {len(names)} convolutions; expected {2 + AT_THE_END} at least, because "
            "the first and the last stay in float32"
        )
    images, f = (values[CHOOSE][:CALIBRATION] for values in (held_out.image, held_out.f))
    with TemporaryDirectory() as folder, _quiet():
        before, after = Path(folder) / "before.onnx", Path(folder) / "after.onnx"
        onnx.save(model, before)
        quantization.quantize_static(
            before,
            after,
            _Images(deployed, images, f),
            quant_format=quantization.QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            nodes_to_exclude=[names[0], *names[-AT_THE_END:]],
            per_channel=True,
            activation_type=quantization.QuantType.QInt8,
            weight_type=quantization.QuantType.QInt8,
            extra_options={"ActivationSymmetric": True, "WeightSymmetric": True},
        )
        return onnx.load(after)


@contextmanager
def _quiet() -> Iterator[None]:
    """No warnings, since onnxruntime advises through the root logger to prepare the graph, which `graph` has done."""
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)


class _Images(quantization.CalibrationDataReader):
    """Inputs of the graph, one batch after the other."""

    def __init__(self, deployed: Deployed, images: Tensor, f: Tensor) -> None:
        self.left = _given(deployed, images, f)

    def get_next(self) -> dict[str, np.ndarray] | None:
        """The inputs of the next batch; None after the last."""
        return next(self.left, None)


def _given(deployed: Deployed, images: Tensor, f: Tensor) -> Iterator[dict[str, np.ndarray]]:
    for inputs in deployed.samples(images, f):
        yield {name: value.numpy() for name, value in zip(deployed.inputs, inputs, strict=True)}


def measured_change(model: Any, deployed: Deployed, held_out: Batch) -> Change:
    """The errors of the held-out images that did not calibrate, in float32 and in the graph's int8."""
    images, xyz, f = (values[GUARANTEE] for values in (held_out.image, held_out.xyz, held_out.f))
    predictor = deployed.predictor
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    raw = np.concatenate([session.run(["raw"], given)[0] for given in _given(deployed, images, f)])
    both = predictor.raw(images.numpy(), f), torch.from_numpy(raw)
    before, after = (_errors(deployed, one, f, xyz) for one in both)
    pairs = [(one, other) for one, other in zip(before, after, strict=True)]
    return Change(len(f), pairs[0], *(pairs[1:] or (None, None)))


def _errors(deployed: Deployed, raw: Tensor, f: Float[Tensor, " n"], xyz: Float[Tensor, "n 3"]) -> tuple[float, ...]:
    """Mean depth error in mm; of a density also the mean NLL and the share of positions inside the 90 % region."""
    prediction, xyz = deployed.predictor.predict(raw, f), xyz.double()
    error = float(MILLIMETRES * depth_error(xyz, prediction.mode).mean())
    if not isinstance(prediction, Density):
        return (error,)
    inside = (prediction.level(xyz) <= INSIDE).double().mean()
    return error, float(-prediction.log_prob(xyz).mean()), float(inside)
