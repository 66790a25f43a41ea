"""The exported graph gives the answers of the torch classes, for any numbers a network may return."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from phd_exp.distributions import Temperature
from phd_exp.geometry import Cartesian, Chart, DepthScale, LogDepth, Projected
from phd_exp.inference.predictor import Predictor
from phd_exp.models.heads import ChartHead, DistributionHead, Head
from phd_exp.training.config import check

onnxruntime = pytest.importorskip("onnxruntime", reason="needs `pip install 'phd_exp[export]'`")

SIDE = 32
DEPTH = DepthScale.from_ranges(f_range=(600.0, 1000.0), z_range=(3.0, 5.0))


class Pixels(nn.Module):
    """Stands in for a regressor: its outputs, from -16 to 16, are the first values of a row of the image."""

    def __init__(self, head: Head, row: int = 0) -> None:
        super().__init__()
        self.head, self.row = head, row

    def raw(self, image: Tensor, f: Tensor | None = None) -> Tensor:
        return (image[:, self.row].flatten(1)[:, : self.head.n_outputs].float() - 128) / 8


def predictor(composed: Callable[..., Any], head: Head, **changes: Any) -> Predictor:
    kept: dict[str, Any] = {"constant_f": None, "temperature": None} | changes
    return Predictor(
        config=check(composed("preset=smoke")),
        regressor=Pixels(head),  # type: ignore[arg-type]
        side=SIDE,
        depth=DEPTH,
        device=torch.device("cpu"),
        state="finished",
        **kept,
    )


def worst(made: Predictor, images: np.ndarray, f: np.ndarray) -> dict[str, np.ndarray]:
    """For each output, the deviation of the graph from torch in each row, relative to its largest element."""
    from phd_exp.inference import onnx
    from phd_exp.inference.deployed import OfImages, answers

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxtyping.config.jaxtyping_disable", True)  # a shape that is checked is a fixed one in a graph
        content = onnx.graph(OfImages(made)).SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    assert [given.name for given in session.get_inputs()] == ["image", "f"]
    raw, *here = session.run(None, {"image": images, "f": f})
    expected = made.raw(images, torch.from_numpy(f)).double()
    np.testing.assert_array_equal(raw, expected.numpy())
    there = answers(made.predict(expected, torch.from_numpy(f).double()))
    assert [out.name for out in session.get_outputs()] == ["raw", *there]
    deviations = {}
    for value, (name, tensor) in zip(here, there.items(), strict=True):
        assert value.shape == tensor.shape
        rows = tensor.numpy().reshape(len(f), -1)
        deviations[name] = np.abs(value.reshape(rows.shape) - rows).max(1) / np.abs(rows).max(1)
    return deviations


@pytest.mark.slow
def test_the_distribution_is_that_of_torch(composed: Callable[..., Any]) -> None:
    made = predictor(composed, DistributionHead(DEPTH), temperature=Temperature(1.3, 0.7))
    draw = np.random.default_rng(0)
    scales = np.repeat([0, 8, 24, 60], [1, 299, 300, 300])[:, None, None]
    images = np.full((len(scales), SIDE, SIDE, 3), 128, dtype=np.uint8)
    images[:, 0] = (128 + scales * draw.standard_normal(images[:, 0].shape)).round().clip(0, 255)
    f = np.linspace(600, 1000, len(images), dtype=np.float32)
    deviations = worst(made, images, f)
    assert deviations.keys() == {"mode", "mean", "covariance", "median_depth", "depth_interval"}
    prediction = made.predict(made.raw(images, torch.from_numpy(f)).double(), torch.from_numpy(f).double())
    # A is inverted, and its inputs have the digits of float32
    sound = torch.linalg.cond(prediction.A).numpy() < 1e6  # type: ignore[union-attr]
    assert sound.mean() > 0.7
    for name, deviation in deviations.items():
        rows = slice(None) if "depth" in name else sound
        assert deviation[rows].max() < 1e-5, name


@pytest.mark.slow
@pytest.mark.parametrize(("networks", "views"), [(3, 1), (1, 8)])
def test_an_ensemble_is_that_of_torch(composed: Callable[..., Any], networks: int, views: int) -> None:
    head = DistributionHead(DEPTH)
    others = tuple(Pixels(head, row) for row in range(1, networks))
    made = predictor(composed, head, others=others, views=views)
    images = np.random.default_rng(0).integers(88, 168, (100, SIDE, SIDE, 3), dtype=np.uint8)
    for name, deviation in worst(made, images, np.linspace(600, 1000, 100, dtype=np.float32)).items():
        assert np.quantile(deviation, 0.9) < 1e-5, name
        assert deviation.max() < 1e-3, name


@pytest.mark.parametrize(("chart", "constant_f"), [(Projected, None), (LogDepth, 777.0), (Cartesian, None)])
def test_baselines_are_points(
    composed: Callable[..., Any], chart: Callable[[DepthScale], Chart], constant_f: float | None
) -> None:
    made = predictor(composed, ChartHead(DEPTH, chart), constant_f=constant_f)
    images = np.random.default_rng(0).integers(124, 136, (50, SIDE, SIDE, 3), dtype=np.uint8)
    (deviation,) = worst(made, images, np.linspace(600, 1000, 50, dtype=np.float32)).values()
    assert deviation.max() < 1e-6
