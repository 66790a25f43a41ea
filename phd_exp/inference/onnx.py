"""A run as an ONNX file: images in, positions with their uncertainty out. `DESCRIPTIONS` describes all names."""

import copy
import json
import logging
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from jaxtyping import Float
from onnx import numpy_helper
from onnx_ir.passes import common as passes
from onnxscript import optimizer
from torch import Tensor, nn

from phd_exp.distributions.regions import PRECISIONS, level_energies
from phd_exp.inference.deployed import Deployed, OfImages, OfPhotographs, Precision
from phd_exp.inference.predictor import Predictor
from phd_exp.records.errors import UserError
from phd_exp.records.files import write_atomic
from phd_exp.records.runs import versions

METADATA = "phd_exp"  # the key of the file's metadata: JSON with the run, the image size and `DESCRIPTIONS`
DESCRIPTIONS = {
    "image": "(n, side, side, 3) uint8: RGB images of side x side pixels, principal point in the middle",
    "f": "(n,) float32: focal length, pixels of these images; all outputs are NaN unless it is positive and finite",
    "photograph": "(height, width, 3) uint8: one RGB image of any size, without distortion",
    "K": "(3, 3) of the type `precision`: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] of the photograph, pixels",
    "boxes": "(n, 4) of the type of K: left, top, right, bottom of each object in the photograph, pixels; n may be "
    "0. Outputs are NaN for a box without area, reversed, outside the photograph, beyond 90 degrees, or not finite",
    "raw": "(n, k) float32: the outputs of the network; of an ensemble (n, members, k)",
    "mode": "(n, 3) float32: position of highest density, m; camera frame: x right, y down, z forward",
    "mean": "(n, 3) float32: expected position, m",
    "covariance": "(n, 3, 3) float32: covariance of the position, m^2",
    "a": "(n,) float32: the depth precision of the density, which decides about guaranteed regions",
    "median_depth": "(n,) float32: median of z, m",
    "depth_interval": "(n, 3, 2) float32: lower and upper end of the central 50, 90 and 99 % intervals of z, m",
    "ray": "(n, 3) float32: unit vector from the camera through the middle of each box",
    "median_along_ray": "(n,) float32: median of the position's coordinate along the ray, m",
    "interval_along_ray": "(n, 3, 2) float32: central 50, 90 and 99 % intervals of that coordinate, m",
    "position": "(n, 3) float32: estimated position of a baseline, m; camera frame as above",
}
ENERGY = (
    "h(|q|) + a (c - 1) + sqrt((a s)^2 + r^2) - r with c = (t + 1/t)/2, s = (t - 1/t)/2, r = rounding and t the "
    "depth over that of the mode; h(x) = x^2/2 up to 1, x - 1/2 beyond. A region has the positions of energy up to "
    "W, which is interpolated linearly over log a"
)
OPSET, IR = 18, 8
"""Versions of the operators and of the format: those of onnx 1.13, since older runtimes refuse later formats."""
TOLERANCE = 1e-5
IN_FLOAT32 = {"covariance": 1e-3}
"""Tolerances of other outputs where these are computed in float32."""
OF_PHOTOGRAPHS = dict.fromkeys(("mode", "mean", "position", "a", "median_along_ray", "interval_along_ray"), 1e-4)
"""Further ones, since a few colours in 100,000 of a crop are rounded to the next whole number."""
OF_PHOTOGRAPHS |= {"raw": 1e-3}
SMALL = 0.01  # size of an output of the network below which it is compared absolutely


def export(
    predictor: Predictor,
    file: Path,
    coverage: float | None = None,
    photographs: bool = False,
    precision: Precision = "float32",
) -> float:
    """Write the file after comparing it with torch; returns the largest relative deviation.

    With a coverage, the metadata has the level of its regions, the `ENERGY` and its W at several depth precisions a.

    Raises UserError, and writes no file, if the deviation exceeds the tolerance.
    """
    deployed = (OfPhotographs if photographs else OfImages)(predictor, precision).eval()
    metadata = _metadata(deployed) | (_region(deployed, coverage) if coverage else {})
    model = graph(deployed)  # last, because it takes half a minute
    deviation = largest_deviation(deployed, model.SerializeToString())
    if not deviation <= TOLERANCE:
        raise UserError(
            f"{file}: not written: it deviates from torch by {deviation:.2g}, more than {TOLERANCE:g}; "
            f"{'precision=float64' if precision == 'float32' else 'another version of onnxruntime or torch'} "
            "may do better"
        )
    model.metadata_props.add(key=METADATA, value=json.dumps(metadata))
    write_atomic(file, model.SerializeToString())
    return deviation


class AxisByAxis(nn.Module):
    """A `GroupNorm` of one group whose means are taken over one axis after the other.

    A runtime may add all numbers of a map in float32 one by one, which costs a digit.
    """

    def __init__(self, norm: nn.GroupNorm) -> None:
        super().__init__()
        self.norm = norm

    def forward(self, x: Float[Tensor, "batch channels *map"]) -> Float[Tensor, "batch channels *map"]:
        centred = x - _mean(x)
        scale = self.norm.weight[:, None, None] * (_mean(centred.square()) + self.norm.eps).rsqrt()
        return centred * scale + self.norm.bias[:, None, None]


def _mean(x: Tensor) -> Tensor:
    return x.mean(3, keepdim=True).mean(2, keepdim=True).mean(1, keepdim=True)


def graph(deployed: Deployed) -> Any:
    """The network and its answers as a graph, for any number of images or boxes."""
    *_, (examples, _, _) = deployed.cases()
    deployed = copy.deepcopy(deployed)
    for module in list(deployed.modules()):
        for name, part in module.named_children():
            if isinstance(part, nn.GroupNorm) and part.num_groups == 1:
                setattr(module, name, AxisByAxis(part))
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of torch and onnxscript about their own old names
        program = torch.onnx.export(
            deployed,
            examples,
            input_names=deployed.inputs,
            output_names=["raw", *_names(deployed)],
            dynamic_shapes=deployed.dynamic_shapes,
            opset_version=OPSET,
            dynamo=True,
            optimize=False,
            verbose=False,
        )
    assert program is not None
    _folded(program.model)
    results = program.model.graph.outputs
    for value in (value for node in program.model.graph for value in node.outputs if value not in results):
        value.name = f"inner_{value.name}"  # the exporter names a mean within the network "mean" too
    model = _with_axes_from_the_front(program.model_proto)
    model.ir_version = IR
    return model


def _folded(model: Any) -> None:
    """Compute what is constant and drop what is unused, in place.

    The exporter's own optimiser also tries all its rules at all nodes, which takes most of an export and changes
    nothing here.
    """
    passes.InlinePass()(model)
    optimizer.fold_constants(model, onnx_shape_inference=True)
    for step in (
        passes.RemoveUnusedNodesPass(),
        passes.RemoveUnusedFunctionsPass(),
        passes.RemoveUnusedOpsetsPass(),
        passes.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0),
        passes.DeduplicateInitializersPass(),
        passes.CommonSubexpressionEliminationPass(),
        passes.NameFixPass(),
    ):
        step(model)


def _with_axes_from_the_front(model: Any) -> Any:
    """The graph with positive axes of reductions, since onnxruntime ignores negative ones of an empty batch."""
    graph = model.graph
    ranks = {value.name: len(value.type.tensor_type.shape.dim) for value in (*graph.value_info, *graph.input)}
    constants = {tensor.name: tensor for tensor in graph.initializer}
    for node in (node for node in graph.node if node.op_type.startswith("Reduce") and len(node.input) > 1):
        rank, axes = ranks[node.input[0]], constants[node.input[1]]
        name = node.input[1] = f"{axes.name}_of_{rank}"
        if name not in constants:
            constants[name] = numpy_helper.from_array(numpy_helper.to_array(axes) % rank, name)
            graph.initializer.append(constants[name])
    used = {name for node in graph.node for name in node.input}
    for unused in [tensor for tensor in graph.initializer if tensor.name not in used]:
        graph.initializer.remove(unused)
    return model


def _names(deployed: Deployed) -> list[str]:
    """The names of the outputs after `raw`."""
    inputs, _, prediction = next(deployed.cases())
    return list(deployed.answers(prediction, *inputs))


def _metadata(deployed: Deployed) -> dict[str, Any]:
    predictor = deployed.predictor
    config, temperature = predictor.config, predictor.temperature
    run = {"preset": config.preset, "data": config.data.name, "model": config.model.name, "seed": config.seed}
    return {
        "version": versions().get("phd_exp", "unknown"),
        "run": run,
        "side": predictor.side,
        "margin": predictor.margin,
        "temperature": asdict(temperature) if temperature else None,
        "precision": str(deployed.dtype).removeprefix("torch."),
        **{name: DESCRIPTIONS[name] for name in (*deployed.inputs, "raw", *_names(deployed))},
    }


def _region(deployed: Deployed, coverage: float) -> dict[str, Any]:
    """The metadata of regions with a guaranteed coverage."""
    guarantee = deployed.predictor.guarantee(coverage)
    *_, prediction = next(deployed.cases())
    assert prediction.has_closed_forms  # only those have a guarantee
    W = level_energies(guarantee.levels[0], prediction.rounding)
    facts = {"coverage": coverage, "level": guarantee.levels[0], "held_out_samples": guarantee.n[0]}
    energy = {"energy": ENERGY, "rounding": prediction.rounding, "a": PRECISIONS.tolist(), "W": W.tolist()}
    return {"region": facts | energy}


def largest_deviation(deployed: Deployed, content: bytes) -> float:
    """The largest relative deviation of the file from `predict` over all `cases`.

    Relative to the largest value of each output of the network over all cases, at least `SMALL`, and to the largest
    element of each vector or matrix that follows. All are scaled to one tolerance.
    """
    tolerances = IN_FLOAT32 | (OF_PHOTOGRAPHS if isinstance(deployed, OfPhotographs) else {})
    tolerances = tolerances if deployed.dtype == torch.float32 else {}
    scales = {name: TOLERANCE / tolerance for name, tolerance in tolerances.items()}
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    found, expected, deviations = [], [], []
    for inputs, raw, prediction in deployed.cases():
        given = {name: value.numpy() for name, value in zip(deployed.inputs, inputs, strict=True)}
        here, *answered = session.run(None, given)
        for value, (name, other) in zip(answered, deployed.answers(prediction, *inputs).items(), strict=True):
            deviations.append(scales.get(name, 1.0) * _relative(value, other))
        found.append(here)
        expected.append(raw.numpy())
    raw_here, raw_there = np.concatenate(found), np.concatenate(expected)
    size = np.maximum(np.abs(raw_there).max(axis=0), SMALL)
    of_raw = scales.get("raw", 1.0) * float((np.abs(raw_here - raw_there) / size).max())
    return max(of_raw, *deviations)


def _relative(here: np.ndarray, there: Tensor) -> float:
    expected = there.numpy().reshape(len(there), -1)
    size = np.abs(expected).max(axis=1, keepdims=True)
    return float((np.abs(here.reshape(expected.shape) - expected) / size).max())
