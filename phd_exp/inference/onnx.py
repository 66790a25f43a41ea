"""A run as an ONNX file: uint8 images in, positions with their uncertainty out.

The graph is traced from the classes that `predict` uses. The network computes in float32 and everything after it in
float64; outputs are float32. `DESCRIPTIONS` describes inputs and outputs.
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

from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.level import PRECISIONS, level_energies
from phd_exp.inference.answers import LEVELS
from phd_exp.inference.predictor import Predictor
from phd_exp.models.heads import Prediction
from phd_exp.records.errors import UserError
from phd_exp.records.files import write_atomic
from phd_exp.records.runs import versions

METADATA = "phd_exp"  # the key of the file's metadata: JSON with the run, the image size and `DESCRIPTIONS`
DESCRIPTIONS = {
    "image": "(batch, side, side, 3) uint8: RGB images of side x side pixels, principal point in the middle",
    "f": "(batch,) float32: focal length, pixels of these images",
    "raw": "(batch, n) float32: the outputs of the network; of an ensemble (batch, members, n)",
    "mode": "(batch, 3) float32: position of highest density, m; camera frame: x right, y down, z forward",
    "mean": "(batch, 3) float32: expected position, m",
    "covariance": "(batch, 3, 3) float32: covariance of the position, m^2",
    "median_depth": "(batch,) float32: median of z, m",
    "depth_interval": "(batch, 3, 2) float32: lower and upper end of the central 50, 90 and 99 % intervals of z, m",
    "position": "(batch, 3) float32: estimated position of a baseline, m; camera frame as above",
}
OPSET = 18
TOLERANCE = 1e-5
SMALL = 0.01  # size of an output of the network below which it is compared absolutely
CHECKED = (1, 7, 56)  # batches of images on which the file is compared with torch
FOCAL_LENGTHS = (5.0, 9.0)  # range for the comparison, in sides of the image


class ParityError(UserError):
    """The exported file and torch disagree."""


class _Deployed(nn.Module):
    """The whole predictor, from images to answers."""

    def __init__(self, predictor: Predictor) -> None:
        super().__init__()
        self.predictor = predictor
        self.networks = nn.ModuleList(predictor.networks)

    def forward(self, image: UInt8[Tensor, "batch S S 3"], f: Float[Tensor, " batch"]) -> tuple[Tensor, ...]:
        raw = self.predictor.outputs(image, self.predictor.camera(f).f)
        answered = outputs(self.predictor.predict(raw.double(), f.double()))
        return (raw, *(value.float() for value in answered.values()))


def outputs(prediction: Prediction) -> dict[str, Tensor]:
    """The outputs of the graph for a batch of predictions, after `raw`."""
    if not isinstance(prediction, ProjectedHuber):
        return {"position": prediction.mode}
    tails = torch.tensor([(1 - level / 100) / 2 for level in LEVELS], dtype=torch.float64)
    p = torch.cat([tails.new_tensor([0.5]), tails, 1 - tails])
    z = prediction.depth_icdf(p[:, None])  # all at once, for a small graph
    return {
        "mode": prediction.mode,
        "mean": prediction.mean,
        "covariance": prediction.covariance_matrix,
        "median_depth": z[0],
        "depth_interval": torch.stack([z[1 : 1 + len(LEVELS)], z[1 + len(LEVELS) :]]).permute(2, 1, 0),
    }


def export(predictor: Predictor, file: Path, coverage: float | None = None) -> float:
    """Write the file after comparing it with torch; returns the largest relative deviation.

    With a coverage, the metadata has the level of its regions and their energy W at each depth precision a.

    Raises ParityError, and writes no file, if that exceeds 1e-5.
    """
    metadata = _metadata(predictor)
    if coverage:
        guarantee = predictor.guarantee(coverage)
        facts = {"coverage": coverage, "level": guarantee.levels[0], "held_out_samples": guarantee.n[0]}
        energies = {"a": PRECISIONS.tolist(), "W": level_energies(guarantee.levels[0]).tolist()}
        metadata["region"] = facts | energies
    model = graph(predictor)
    model.metadata_props.add(key=METADATA, value=json.dumps(metadata))
    content = model.SerializeToString()
    deviation = largest_deviation(predictor, content)
    if not deviation <= TOLERANCE:
        raise ParityError(
            f"{file}: not written: it deviates from torch by {deviation:.2g}, more than {TOLERANCE:g}; "
            "another version of onnxruntime or torch may do better"
        )
    write_atomic(file, content)
    return deviation


def graph(predictor: Predictor) -> Any:
    """The network and its answers as a graph, for batches of any size."""
    side = predictor.side
    examples = torch.zeros(2, side, side, 3, dtype=torch.uint8), torch.tensor(FOCAL_LENGTHS) * side
    batch = torch.export.Dim("batch", min=1)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch and onnxscript about their own old names
        program = torch.onnx.export(
            _Deployed(predictor).eval(),
            examples,
            input_names=["image", "f"],
            output_names=["raw", *_names(predictor)],
            dynamic_shapes={"image": {0: batch}, "f": {0: batch}},
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    results = program.model.graph.outputs
    for value in (value for node in program.model.graph for value in node.outputs if value not in results):
        value.name = f"inner_{value.name}"  # the exporter names a mean within the network "mean" too
    return program.model_proto


def _names(predictor: Predictor) -> list[str]:
    """The names of the outputs after `raw`."""
    head = predictor.regressor.head
    members = [len(predictor.networks) * predictor.views] if predictor.is_ensemble else []
    raw = torch.zeros(1, *members, head.n_outputs, dtype=torch.float64)
    return list(outputs(predictor.predict(raw, torch.ones(1).double())))


def _metadata(predictor: Predictor) -> dict[str, Any]:
    config, temperature = predictor.config, predictor.temperature
    run = {"preset": config.preset, "data": config.data.name, "model": config.model.name, "seed": config.seed}
    return {
        "version": versions().get("phd_exp", "unknown"),
        "run": run,
        "side": predictor.side,
        "temperature": asdict(temperature) if temperature else None,
        **{name: DESCRIPTIONS[name] for name in ("image", "f", "raw", *_names(predictor))},
    }


def largest_deviation(predictor: Predictor, content: bytes) -> float:
    """The largest relative deviation of the file from torch, over 64 images in three batches.

    Relative to the largest value of each output of the network over all images, at least `SMALL`, and to the largest
    element of each vector or matrix that follows.
    """
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    n, side = sum(CHECKED), predictor.side
    images = pictures(n, side)
    f = (side * np.linspace(*FOCAL_LENGTHS, n)).astype(np.float32)
    parts = np.split(np.arange(n), np.cumsum(CHECKED)[:-1])
    runs = [session.run(None, {"image": images[rows], "f": f[rows]}) for rows in parts]
    raw, *answered = (np.concatenate(values) for values in zip(*runs, strict=True))
    expected = torch.cat([predictor.raw(images[rows], torch.from_numpy(f[rows])) for rows in parts])
    size = np.maximum(np.abs(expected.numpy()).max(axis=0), SMALL)
    there = outputs(predictor.predict(expected.double(), torch.from_numpy(f).double()))
    deviations = [_relative(here, value) for here, value in zip(answered, there.values(), strict=True)]
    return max(float((np.abs(raw - expected.numpy()) / size).max()), *deviations)


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
