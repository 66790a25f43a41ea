"""The exported graph gives the answers of the torch classes, for any numbers a network may return."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from phd_exp.config import check
from phd_exp.distributions import Mixture, Temperature
from phd_exp.distributions.temperature import Slope
from phd_exp.geometry import Camera, Cartesian, Chart, DepthScale, LogDepth, Projected
from phd_exp.inference.deployed import OfPhotographs, answers, require_exportable
from phd_exp.inference.predictor import Predictor
from phd_exp.models.heads import ChartHead, DistributionHead, Head, MixtureHead, SurrogateHead
from phd_exp.models.regressor import Regressor
from phd_exp.models.trained import TrainedNetwork
from phd_exp.records.errors import ConfigError
from tests.support.densities import BASELINES, SHAPED, predicted, raw_numbers
from tests.support.portable import NoChoiceOfTruths, openvino_outputs, require_portable
from tests.support.raw_numbers import hostile

onnxruntime = pytest.importorskip("onnxruntime", reason="needs `pip install 'phd_exp[export]'`")

pytestmark = pytest.mark.timeout(1800)  # s; an export takes half a minute of a core, which others may use too
ORT = ["CPUExecutionProvider"]
TOLERANCES = {"covariance": 1e-3}
"""Of float32, relative; of all other answers 1e-5."""
SIDE = 32
DEPTH = DepthScale.from_ranges(f_range=(600.0, 1000.0), z_range=(3.0, 5.0))


class Table(Regressor):
    """Stands in for a regressor: the first three bytes of an image number a row of outputs, modulo their number."""

    rows: Tensor

    def __init__(self, head: Head, numbers: Tensor) -> None:
        nn.Module.__init__(self)
        self.head = head
        self.register_buffer("rows", numbers[:, : head.n_outputs].float())

    def raw(self, image: Tensor, f: Tensor | None = None) -> Tensor:
        row = (image[:, 0, 0].long() * torch.tensor([1, 256, 65536])).sum(-1)
        return self.rows[row % len(self.rows)]


def images_of(rows: np.ndarray) -> np.ndarray:
    """Images that number these rows of a `Table`."""
    images = np.zeros((len(rows), SIDE, SIDE, 3), dtype=np.uint8)
    images[:, 0, 0] = rows[:, None] // [1, 256, 65536] % 256
    return images


def draws(n: int, extreme: int) -> Tensor:
    """Raw numbers throughout the documented range, then at its ends."""
    generator = torch.Generator().manual_seed(0)
    return torch.cat([raw_numbers("free_axis", n, generator), hostile(extreme, generator)])


def predictor(
    composed: Callable[..., Any],
    head: Head,
    *numbers: Tensor,
    constant_f: float | None = None,
    views: int = 1,
    **changes: Any,
) -> Predictor:
    """Of a network for each table of numbers."""
    network = TrainedNetwork([Table(head, one) for one in numbers], SIDE, constant_f, views)
    return Predictor(check(composed("preset=smoke")), network, DEPTH, "finished", (), **changes)


def exported(made: Predictor, kind: str = "OfImages", precision: str = "float32") -> Any:
    """The graph of images or of photographs."""
    from phd_exp.inference import deployed, onnx

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxtyping.config.jaxtyping_disable", True)  # a shape that is checked is a fixed one in a graph
        return onnx.graph(getattr(deployed, kind)(made, precision))


def session_of(model: Any) -> Any:
    """The graph in onnxruntime."""
    return onnxruntime.InferenceSession(model.SerializeToString(), providers=ORT)


def deviations(here: Sequence[np.ndarray], there: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Of each output, the deviation in each row, relative to its largest element."""
    found = []
    for value, expected in zip(here, there, strict=True):
        assert value.shape == expected.shape
        rows = expected.reshape(len(expected), -1).astype(float)
        found.append(np.abs(value.reshape(rows.shape) - rows).max(1) / np.abs(rows).max(1))
    return found


def worst(made: Predictor, session: Any, images: np.ndarray, f: np.ndarray) -> dict[str, np.ndarray]:
    """For each output, the deviation of the graph from torch in float64, in each row."""
    assert [given.name for given in session.get_inputs()] == ["image", "f"]
    raw, *here = session.run(None, {"image": images, "f": f})
    expected = made.raw(images, torch.from_numpy(f)).double()
    np.testing.assert_array_equal(raw, expected.numpy())
    there = answers(made.predict(expected, torch.from_numpy(f).double()))
    assert [out.name for out in session.get_outputs()] == ["raw", *there]
    return dict(zip(there, deviations(here, [value.numpy() for value in there.values()]), strict=True))


def require_accurate(found: dict[str, np.ndarray]) -> None:
    """Fails where an answer deviates by more than its tolerance."""
    for name, deviation in found.items():
        assert deviation.max() < TOLERANCES.get(name, 1e-5), name


HEADS = {
    "ray": DistributionHead(DEPTH),
    "free": DistributionHead(DEPTH, free_axis=True),
    "rounded": SurrogateHead(DEPTH, is_rounded=True),
}


@pytest.mark.parametrize("name", HEADS)
def test_float32_has_the_digits_of_float64(name: str) -> None:
    head, raw = HEADS[name], draws(10_000, 10_000).float()
    raw = torch.cat([raw, torch.linspace(-10, 1000, len(raw))[:, None]], dim=1)  # the last is of degrees of freedom
    f = torch.linspace(2, 9, len(raw)) * SIDE
    here, there = (
        answers(head(raw[:, : head.n_outputs].to(dtype), Camera(f.to(dtype), float(SIDE))))
        for dtype in (torch.float32, torch.float64)
    )
    assert all(value.dtype == torch.float32 for value in here.values())
    values = ([value.numpy() for value in one.values()] for one in (here, there))
    require_accurate(dict(zip(there, deviations(*values), strict=True)))


OTHERS = {*SHAPED, *BASELINES, "rounded_t"} - {"gaussian_mixture"}


@pytest.mark.parametrize("name", sorted(OTHERS))
def test_float32_has_the_digits_of_float64_in_the_modes_of_other_densities(name: str) -> None:
    raw = raw_numbers(name, 10_000, torch.Generator().manual_seed(0)).float()
    f = torch.linspace(600, 2000, len(raw))
    found = (predicted(name, raw.to(dtype), Camera(f.to(dtype), 224.0)) for dtype in (torch.float32, torch.float64))
    here, there = (getattr(one, "estimate", one).mode.numpy() for one in found)
    assert deviations([here], [there])[0].max() < 1e-5


TEMPERATURE = Temperature(1.3, 0.7, Slope(0.1, 3.0, 8.0), Slope(-0.2, 2.0, 6.0))


def disagreeing(raw: Tensor, widths: float, members: int) -> Tensor:
    """Raw numbers of members whose modes differ by about so many widths of their densities, a at least 0.4."""
    noise = torch.randn((len(raw), members, 9), generator=torch.Generator().manual_seed(0), dtype=raw.dtype)
    raw = raw[:, None] + widths * noise * (raw[:, None].abs() * torch.tensor([0, 0, 0.05, 0.05, 0.05, 0.05, 0, 0, 0]))
    raw = raw + widths * noise * torch.tensor([1, 1, 0, 0, 0, 0, 1, 0.3, 0.3])
    return torch.cat([raw[..., :5], raw[..., 5:6].clamp_min(-1), raw[..., 6:]], dim=-1).float()


@pytest.mark.parametrize("widths", [0.0, 1.0])
@pytest.mark.parametrize(("n_outputs", "rounding"), [(7, 0.0), (9, 0.0), (9, 2.0)])
def test_float32_has_the_digits_of_float64_in_ensembles(widths: float, n_outputs: int, rounding: float) -> None:
    """Of eight members, for which digits cancel most where they are equal."""
    raw = raw_numbers("free_axis", 1_000, torch.Generator().manual_seed(0))
    raw = disagreeing(raw, widths, 8)[..., :n_outputs]
    f, head = torch.linspace(2, 9, len(raw))[:, None] * SIDE, DistributionHead(DEPTH, free_axis=n_outputs == 9)
    with NoChoiceOfTruths():
        here, there = (
            answers(Mixture(head(raw.to(dtype), Camera(f.to(dtype), float(SIDE))).with_rounding(rounding)).closest)
            for dtype in (torch.float32, torch.float64)
        )
    values = ([value.numpy() for value in one.values()] for one in (here, there))
    for name, deviation in zip(there, deviations(*values), strict=True):
        tolerance = TOLERANCES.get(name, 1e-5)
        assert deviation.max() < 10 * tolerance, name  # mode and mean along a steep axis, and a
        assert np.quantile(deviation, 0.99) < tolerance * (10 if name == "a" else 1), name


def made(composed: Callable[..., Any], name: str) -> Predictor:
    """The ensemble has two networks with eight views each."""
    if name == "ensemble":
        raw = torch.tensor([[0.0, 0, 90, 15, 120, 60, 4, 1.2, -0.5]]).expand(100, 9)
        return predictor(composed, HEADS["free"], *disagreeing(raw, 1.0, 2).unbind(1), views=8)
    generator = torch.Generator().manual_seed(0)
    numbers = draws(10_000, 2_000) if name == "free" else raw_numbers("rounded_t", 1_000, generator)
    return predictor(composed, HEADS[name], numbers, temperature=TEMPERATURE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "precision"),
    [("free", "float32"), ("rounded", "float32"), ("rounded", "float64"), ("ensemble", "float32")],
)
def test_a_graph_gives_the_answers_of_torch_in_every_runtime(
    composed: Callable[..., Any], name: str, precision: str
) -> None:
    one = made(composed, name)
    n = len(one.network.networks[0].rows)  # type: ignore[attr-defined]
    images, f = images_of(np.arange(n)), np.linspace(2, 9, n, dtype=np.float32) * SIDE
    model = exported(one, precision=precision)
    session = session_of(model)
    found = worst(one, session, images, f)
    assert found.keys() == {"mode", "mean", "covariance", "a", "median_depth", "depth_interval"}
    require_accurate(found)
    if precision == "float32":
        require_portable(model)
    if name == "rounded":
        return
    other = openvino_outputs(model.SerializeToString(), {"image": images, "f": f})
    np.testing.assert_array_equal(other[0], session.run(["raw"], {"image": images, "f": f})[0])
    raw, known = one.raw(images, torch.from_numpy(f)).double(), torch.from_numpy(f).double()
    there = [value.numpy() for value in answers(one.predict(raw, known)).values()]
    require_accurate(dict(zip(found, deviations(other[1:], there), strict=True)))


POINTS = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def sessions(composed: Callable[..., Any]) -> dict[str, Any]:
    """The graphs of a baseline, of photographs and of images."""
    made = predictor(composed, ChartHead(DEPTH, Projected), POINTS)
    graphs = {kind: exported(made, kind) for kind in ("OfPhotographs", "OfImages")}
    for graph in graphs.values():
        require_portable(graph)
    return {kind: session_of(graph) for kind, graph in graphs.items()}


OTHER_CHARTS = [pytest.param(*case, marks=pytest.mark.slow) for case in ((LogDepth, 777.0), (Cartesian, None))]


@pytest.mark.parametrize(("chart", "constant_f"), [(Projected, None), *OTHER_CHARTS])
def test_baselines_are_points(
    composed: Callable[..., Any], sessions: dict[str, Any], chart: Callable[..., Chart], constant_f: float | None
) -> None:
    made = predictor(composed, ChartHead(DEPTH, chart), POINTS, constant_f=constant_f)
    session = sessions["OfImages"] if chart is Projected else session_of(exported(made))
    images, f = images_of(np.arange(50)), np.linspace(600, 1000, 50, dtype=np.float32)
    (deviation,) = worst(made, session, images, f).values()
    assert deviation.max() < 1e-6


def test_a_mixture_of_gaussians_is_refused(composed: Callable[..., Any]) -> None:
    made = predictor(composed, MixtureHead(DEPTH, 2), torch.zeros(1, 20))
    with pytest.raises(ConfigError, match="mixture of Gaussians needs inverse matrices"):
        require_exportable(made)


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


def test_a_margin_enlarges_the_boxes_of_photographs(composed: Callable[..., Any]) -> None:
    head, numbers = DistributionHead(DEPTH), torch.randn(50, 7, generator=torch.Generator().manual_seed(0))
    narrow, wide = (OfPhotographs(predictor(composed, head, numbers, margin=margin)) for margin in (1.0, 1.5))
    given = torch.from_numpy(PHOTOGRAPH), torch.from_numpy(K).float()
    larger = narrow(*given, torch.tensor([[7.5, -2.5, 82.5, 72.5]]))
    for value, expected in zip(wide(*given, torch.tensor([BOX])), larger, strict=True):
        torch.testing.assert_close(value, expected)


def test_a_graph_answers_no_boxes_with_nothing_and_boxes_that_are_none_with_nan(sessions: dict[str, Any]) -> None:
    def answers(
        boxes: list[list[float]], photograph: np.ndarray = PHOTOGRAPH, camera: np.ndarray = K
    ) -> list[np.ndarray]:
        given = {"photograph": photograph, "K": camera.astype("f"), "boxes": np.array(boxes, "f").reshape(-1, 4)}
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
