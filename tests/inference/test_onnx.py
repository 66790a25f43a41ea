"""The exported graph gives the answers of the torch classes, for any numbers a network may return."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from phd_exp.config import check
from phd_exp.distributions import Temperature
from phd_exp.geometry import Cartesian, Chart, DepthScale, LogDepth, Projected
from phd_exp.inference.predictor import Predictor
from phd_exp.models.heads import ChartHead, DistributionHead, Head

onnxruntime = pytest.importorskip("onnxruntime", reason="needs `pip install 'phd_exp[export]'`")

pytestmark = pytest.mark.timeout(1800)  # s; an export takes half a minute of a core, which others may use too
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


def exported(made: Predictor, kind: str = "OfImages") -> Any:
    """A session of the graph of images or of photographs."""
    from phd_exp.inference import deployed, onnx

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxtyping.config.jaxtyping_disable", True)  # a shape that is checked is a fixed one in a graph
        content = onnx.graph(getattr(deployed, kind)(made)).SerializeToString()
    return onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])


def worst(made: Predictor, session: Any, images: np.ndarray, f: np.ndarray) -> dict[str, np.ndarray]:
    """For each output, the deviation of the graph from torch in each row, relative to its largest element."""
    from phd_exp.inference.deployed import answers

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
@pytest.mark.parametrize("free_axis", [False, True])
def test_the_distribution_is_that_of_torch(composed: Callable[..., Any], free_axis: bool) -> None:
    made = predictor(composed, DistributionHead(DEPTH, free_axis), temperature=Temperature(1.3, 0.7))
    draw = np.random.default_rng(0)
    scales = np.repeat([0, 8, 24, 60], [1, 299, 300, 300])[:, None, None]
    images = np.full((len(scales), SIDE, SIDE, 3), 128, dtype=np.uint8)
    images[:, 0] = (128 + scales * draw.standard_normal(images[:, 0].shape)).round().clip(0, 255)
    f = np.linspace(600, 1000, len(images), dtype=np.float32)
    deviations = worst(made, exported(made), images, f)
    assert deviations.keys() == {"mode", "mean", "covariance", "median_depth", "depth_interval"}
    prediction = made.predict(made.raw(images, torch.from_numpy(f)).double(), torch.from_numpy(f).double())
    # A is inverted, and its inputs have the digits of float32
    sound = torch.linalg.cond(prediction.A).numpy() < 1e6  # type: ignore[union-attr]
    assert sound.mean() > 0.7
    for name, deviation in deviations.items():
        rows = slice(None) if "depth" in name else sound
        assert deviation[rows].max() < 1e-5, name


@pytest.mark.slow
@pytest.mark.parametrize(("networks", "views", "free_axis"), [(3, 1, False), (1, 8, False), (1, 8, True)])
def test_an_ensemble_is_that_of_torch(
    composed: Callable[..., Any], networks: int, views: int, free_axis: bool
) -> None:
    head = DistributionHead(DEPTH, free_axis)
    others = tuple(Pixels(head, row) for row in range(1, networks))
    made = predictor(composed, head, others=others, views=views)
    images = np.random.default_rng(0).integers(88, 168, (100, SIDE, SIDE, 3), dtype=np.uint8)
    f = np.linspace(600, 1000, 100, dtype=np.float32)
    for name, deviation in worst(made, exported(made), images, f).items():
        assert np.quantile(deviation, 0.9) < 1e-5, name
        assert deviation.max() < 1e-3, name


@pytest.fixture(scope="module")
def sessions(composed: Callable[..., Any]) -> dict[str, Any]:
    """The graphs of a baseline, of photographs and of images."""
    made = predictor(composed, ChartHead(DEPTH, Projected))
    return {kind: exported(made, kind) for kind in ("OfPhotographs", "OfImages")}


OTHERS = [pytest.param(*case, marks=pytest.mark.slow) for case in ((LogDepth, 777.0), (Cartesian, None))]


@pytest.mark.parametrize(("chart", "constant_f"), [(Projected, None), *OTHERS])
def test_baselines_are_points(
    composed: Callable[..., Any], sessions: dict[str, Any], chart: Callable[..., Chart], constant_f: float | None
) -> None:
    made = predictor(composed, ChartHead(DEPTH, chart), constant_f=constant_f)
    session = sessions["OfImages"] if chart is Projected else exported(made)
    images = np.random.default_rng(0).integers(124, 136, (50, SIDE, SIDE, 3), dtype=np.uint8)
    (deviation,) = worst(made, session, images, np.linspace(600, 1000, 50, dtype=np.float32)).values()
    assert deviation.max() < 1e-6


PHOTOGRAPH = np.random.default_rng(0).integers(0, 256, (90, 120, 3), dtype=np.uint8)
K = np.array([[150.0, 0, 60], [0, 150, 45], [0, 0, 1]])
BOX = [20.0, 10, 70, 60]
NO_BOXES = {
    "no width": [20, 10, 20, 60],
    "reversed": [70, 60, 20, 10],
    "outside": [130, 10, 170, 60],
    "above": [20, -50, 70, -1],
    "NaN": [np.nan, 10, 70, 60],
    "infinite": [20, 10, np.inf, 60],
    "90 degrees from the axis": [-1e5, 10, 1e5, 60],
}


def test_a_graph_answers_no_boxes_with_nothing_and_boxes_that_are_none_with_nan(sessions: dict[str, Any]) -> None:
    def answers(
        boxes: list[list[float]], photograph: np.ndarray = PHOTOGRAPH, camera: np.ndarray = K
    ) -> list[np.ndarray]:
        given = {"photograph": photograph, "K": camera, "boxes": np.array(boxes, float).reshape(-1, 4)}
        return sessions["OfPhotographs"].run(None, given)

    alone = answers([BOX])
    assert all(np.isfinite(value).all() for value in alone)
    assert [value.shape for value in answers([])] == [(0, *value.shape[1:]) for value in alone]
    for value, expected in zip(answers([*NO_BOXES.values(), BOX]), alone, strict=True):
        assert np.isnan(value[:-1]).all()
        np.testing.assert_array_equal(value[-1:], expected)
    for photograph in (PHOTOGRAPH[:0], PHOTOGRAPH[:, :0]):
        assert all(np.isnan(value).all() for value in answers([BOX], photograph))
    for camera in (K * [[0], [1], [1]], K * np.nan, -K):
        assert all(np.isnan(value).all() for value in answers([BOX], camera=camera))


def test_a_graph_answers_no_images_with_nothing_and_impossible_focal_lengths_with_nan(
    sessions: dict[str, Any],
) -> None:
    f = np.array([700, np.nan, 0, -700, np.inf], dtype=np.float32)
    images = np.zeros((len(f), SIDE, SIDE, 3), dtype=np.uint8)
    for value in sessions["OfImages"].run(None, {"image": images, "f": f}):
        assert np.isfinite(value[0]).all()
        assert np.isnan(value[1:]).all()
    empty = sessions["OfImages"].run(None, {"image": images[:0], "f": f[:0]})
    assert [value.shape for value in empty] == [(0, 3), (0, 3)]
