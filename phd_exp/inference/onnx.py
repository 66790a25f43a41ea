"""A run's network as an ONNX file: uint8 images in, the numbers before the head out; checked against torch.

The graph takes `image`, (batch, side, side, 3) of 8 bits, RGB, and of a network that is shown it `f`, (batch,), the
focal lengths in pixels of these images. It returns `raw`, (batch, 7) or (batch, 3) in float32; normalisation is
inside. What the numbers mean is in the file's metadata, for `decoder.py`.
"""

import json
import logging
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

import phd_exp
from phd_exp.distributions import ProjectedHuber
from phd_exp.geometry.charts import Cartesian
from phd_exp.inference.decoder import METADATA, Decoder, Position
from phd_exp.inference.predictor import Predictor
from phd_exp.models.heads import ChartHead
from phd_exp.models.regressor import Regressor
from phd_exp.records.errors import UserError
from phd_exp.records.files import write_atomic

OPSET = 18
TOLERANCE = 1e-5
SMALL = 0.01
"""Size of an output of the network below which its relative deviation says nothing."""
CHECKED = (1, 7, 56)
"""Batches of images in which the exported network is held against torch."""
FOCAL_LENGTHS = (5.0, 9.0)
"""Of the check, from and to, in sides of the image."""
QUANTILES = (0.005, 0.05, 0.25, 0.5, 0.75, 0.95, 0.995)


class ParityError(UserError):
    """The exported network, or its decoder, says something else than torch."""


class _Raw(nn.Module):
    """The regressor without its head; what is shown no focal length takes none."""

    def __init__(self, regressor: Regressor) -> None:
        super().__init__()
        self.regressor = regressor

    def forward(
        self, image: UInt8[Tensor, "batch S S 3"], f: Float[Tensor, " batch"] | None = None
    ) -> Float[Tensor, "batch n_outputs"]:
        return self.regressor.raw(image, f)


def export(predictor: Predictor, file: Path) -> float:
    """Write the network and check the file; returns the largest relative deviation from torch.

    Raises ParityError, and leaves no file, where that exceeds 1e-5.
    """
    model = _exported(predictor)
    for key, value in _metadata(predictor).items():
        model.metadata_props.add(key=key, value=value)
    content = model.SerializeToString()
    deviation = largest_deviation(predictor, content)
    if not deviation <= TOLERANCE:
        raise ParityError(
            f"{file}: not written: it deviates from torch by {deviation:.2g}, more than {TOLERANCE:g}; "
            "another version of onnxruntime or torch may do better"
        )
    write_atomic(file, content)
    return deviation


def _exported(predictor: Predictor) -> Any:
    """The graph, for batches of any size."""
    side = predictor.side
    examples = {"image": torch.zeros(2, side, side, 3, dtype=torch.uint8)}
    if predictor.regressor.shown is not None:
        examples["f"] = torch.tensor(FOCAL_LENGTHS) * side
    batch = torch.export.Dim("batch", min=1)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch and onnxscript about their own old names
        program = torch.onnx.export(
            _Raw(predictor.regressor).cpu().eval(),
            tuple(examples.values()),
            input_names=list(examples),
            output_names=["raw"],
            dynamic_shapes={name: {0: batch} for name in examples},
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    return program.model_proto


def _metadata(predictor: Predictor) -> dict[str, str]:
    config = predictor.config
    run = {"preset": config.preset, "data": config.data.name, "model": config.model.name, "seed": config.seed}
    about = {"version": phd_exp.__version__, "run": run, "decoder": asdict(decoder_of(predictor))}
    return {METADATA: json.dumps(about)}


def decoder_of(predictor: Predictor) -> Decoder:
    """What decodes the network's numbers as `predictor` does."""
    head, temperature = predictor.regressor.head, predictor.temperature
    chart = head.chart if isinstance(head, ChartHead) else None
    return Decoder(
        side=predictor.side,
        head="ProjectedHuber" if chart is None else type(chart).__name__,
        **asdict(predictor.depth),
        xy_unit=chart.xy_unit if isinstance(chart, Cartesian) else 1.0,
        constant_f=predictor.constant_f,
        temperature=(temperature.projected, temperature.depth) if temperature else (1.0, 1.0),
    )


def largest_deviation(predictor: Predictor, content: bytes) -> float:
    """The largest relative deviation of the file and its decoder from torch, over 64 images in three batches.

    Relative to the size of each output of the network over all images, and to that of each decoded vector or matrix.
    Outputs are of order one by design; of one that is near zero on all images, since the network is hardly trained,
    the digits are rounding, and it is held against `SMALL`.
    """
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    decoder = Decoder.of(session.get_modelmeta().custom_metadata_map)
    n, side = sum(CHECKED), predictor.side
    images = pictures(n, side)
    f = (side * np.linspace(*FOCAL_LENGTHS, n)).astype(np.float32)
    taken = {given.name for given in session.get_inputs()}
    batches = [
        {"image": images[rows], "f": f[rows]} for rows in np.split(np.arange(n), np.cumsum(CHECKED)[:-1])
    ]
    here = np.concatenate(
        [session.run(["raw"], {name: batch[name] for name in taken})[0] for batch in batches]
    )
    there = torch.cat([predictor.raw(batch["image"], torch.from_numpy(batch["f"])) for batch in batches])
    size = np.maximum(np.abs(there.numpy()).max(axis=0), SMALL)
    decoded = _decoded(predictor, decoder, here, there.double(), f)
    return max(float((np.abs(here - there.numpy()) / size).max()), *decoded)


def _decoded(
    predictor: Predictor, decoder: Decoder, here: np.ndarray, there: Tensor, f: np.ndarray
) -> list[float]:
    prediction = predictor.predict(there, torch.from_numpy(f).double())
    position = decoder(here, f)
    if not (isinstance(prediction, ProjectedHuber) and isinstance(position, Position)):
        return [_relative(np.asarray(position), prediction.mode)]
    quantiles = torch.stack([prediction.depth_icdf(p) for p in QUANTILES], dim=-1)
    return [
        _relative(position.mode, prediction.mode),
        _relative(position.mean, prediction.mean),
        _relative(position.covariance, prediction.covariance_matrix),
        _relative(position.depth_quantile(QUANTILES), quantiles),
    ]


def _relative(here: np.ndarray, there: Tensor) -> float:
    expected = there.numpy().reshape(len(there), -1)
    size = np.abs(expected).max(axis=1, keepdims=True)
    return float((np.abs(here.reshape(expected.shape) - expected) / size).max())


def pictures(n: int, side: int) -> UInt8[np.ndarray, "n side side 3"]:
    """Images with shapes large and small, the same every time: coarse noise enlarged, and fine noise over it."""
    draw = np.random.default_rng(0)
    coarse = draw.integers(0, 256, (n, 8, 8, 3)).repeat(-(-side // 8), axis=1).repeat(-(-side // 8), axis=2)
    fine = draw.normal(0, 12, (n, side, side, 3))
    return (coarse[:, :side, :side] + fine).clip(0, 255).astype(np.uint8)
