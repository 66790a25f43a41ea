"""A network in int8: what is quantised, what it costs, and that too much is refused."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from phd_exp.data.batches import Batch
from phd_exp.inference.loading import load
from phd_exp.records.errors import ConfigError, UserError
from phd_exp.records.runs import RunFolder
from tests.support.portable import openvino_outputs, require_portable
from tests.support.untrained import SIDE, SMALL, untrained, write_photos

pytest.importorskip("onnxruntime", reason="needs `pip install 'phd_exp[export]'`")
numpy_helper = pytest.importorskip("onnx.numpy_helper")

pytestmark = pytest.mark.timeout(1800)  # s; an export takes half a minute of a core, which others may use too
FILE = Path("network.onnx")


def test_too_large_a_change_is_refused_with_its_figures() -> None:
    from phd_exp.inference.onnx_int8 import Change

    Change(500, (75.0, 77.2), (-10.12, -10.03), (0.9, 0.88)).require_small(FILE)
    Change(500, (75.0, 50.0), None, None).require_small(FILE)
    figures = r"depth error 75\.00 -> 77\.30 mm \(\+3\.1 %\)"
    for change, said in (
        (Change(500, (75.0, 77.3), (-10.12, -10.12), (0.9, 0.88)), figures),
        (Change(500, (75.0, 77.3), None, None), figures),
        (Change(500, (75.0, 75.0), (-10.12, -10.01), (0.9, 0.88)), r"NLL -10\.120 -> -10\.010 nats"),
        (Change(500, (75.0, float("nan")), (-10.12, -10.12), (0.9, 0.88)), r"nan"),
    ):
        expected = rf"network\.onnx: not written: quantize=int8 .*{said}.*3 % and 0\.1 nats"
        with pytest.raises(UserError, match=expected):
            change.require_small(FILE)


def test_a_network_without_convolutions_is_refused() -> None:
    from onnx import ModelProto

    from phd_exp.inference.onnx_int8 import quantized

    with pytest.raises(ConfigError, match="quantize: got a network with 0 convolutions; expected 4 at least"):
        quantized(ModelProto(), None, None)  # type: ignore[arg-type]


def test_several_networks_are_refused(
    phd_exp: Callable[..., Any], composed: Callable[..., Any], tmp_path: Path
) -> None:
    """Which convolutions stay exact is known of one network."""
    run = untrained(tmp_path / "run", composed(*SMALL, "data=folder", "data.folder=nowhere"))
    outcome = phd_exp("export", f"run={run.path},{run.path}", "quantize=int8")
    assert (outcome.status, outcome.error) == (2, "quantize: got 2 networks; expected a single run")


@pytest.fixture(scope="module")
def exported(composed: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> tuple[RunFolder, Any, Any]:
    """A run that holds out 40 of the user's own images, and its network as a graph in float32."""
    from phd_exp.inference.deployed import OfImages
    from phd_exp.inference.onnx import graph

    place = tmp_path_factory.mktemp("int8")
    (place / "photos").mkdir()
    for split, n in (("train", 48), ("test", 2)):
        write_photos(place / "photos" / split, n)
    own = ("data=folder", f"data.folder={place / 'photos'}", "data.n_held_out=40")
    run = untrained(place / "run", composed(*SMALL, *own, "data.n_train=8", "data.batch_size=8"))
    deployed = OfImages(load(run.path, "cpu"), "float32").eval()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxtyping.config.jaxtyping_disable", True)  # a checked shape would be fixed in the graph
        return run, deployed, graph(deployed)


@pytest.mark.slow
def test_the_command_measures_held_out_images_and_refuses_a_loss(
    phd_exp: Callable[..., Any], exported: tuple[RunFolder, Any, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from phd_exp.inference import onnx, onnx_int8

    run, _, model = exported
    monkeypatch.setattr(onnx, "graph", lambda _: model)
    words = ("export", f"run={run.path}", "out=here.onnx", "quantize=int8")
    monkeypatch.setattr(onnx_int8, "MOST_NLL", -np.inf)
    assert phd_exp(*words).error.startswith("here.onnx: not written: quantize=int8 costs too much: depth error ")
    assert not (tmp_path / "here.onnx").exists()
    monkeypatch.setattr(onnx_int8, "MOST_NLL", np.inf)
    monkeypatch.setattr(onnx_int8, "MOST_DEPTH_ERROR", np.inf)
    outcome = phd_exp(*words)
    assert outcome.status == 0, outcome.err
    assert " on 20 held-out images" in outcome.out
    session = onnx.onnxruntime.InferenceSession(tmp_path / "here.onnx")
    said = json.loads(session.get_modelmeta().custom_metadata_map["phd_exp"])["int8"]
    assert said["images"] == 20
    assert f"NLL {said['nll'][0]:.3f} -> {said['nll'][1]:.3f} nats" in outcome.out


@pytest.mark.slow
def test_convolutions_are_in_int8_and_errors_are_those_of_the_graph(exported: tuple[RunFolder, Any, Any]) -> None:
    from phd_exp.inference.deployed import pictures
    from phd_exp.inference.onnx_int8 import measured_change, quantized

    _, deployed, before = exported
    predictor, images, f = deployed.predictor, pictures(80, SIDE, SIDE), torch.linspace(200, 300, 80)
    p = predictor.predict(predictor.raw(images, f), f)
    xyz = p.rsample(generator=torch.Generator().manual_seed(0)).float()
    held_out = Batch(torch.from_numpy(images), xyz, f, float(SIDE), torch.arange(80))
    after = quantized(before, deployed, held_out)
    require_portable(after)
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in after.graph.initializer}
    nodes = {output: node for node in after.graph.node for output in node.output}
    convolutions = [node for node in after.graph.node if node.op_type == "Conv"]
    exact = [node for node in convolutions if nodes[node.input[0]].op_type != "DequantizeLinear"]
    assert exact == [convolutions[0], *convolutions[-2:]]
    for node in nodes.values():
        if node.op_type in ("QuantizeLinear", "DequantizeLinear"):
            zero = constants[node.input[2]]
            assert (zero == 0).all()
    untouched, change = (measured_change(model, deployed, held_out) for model in (before, after))
    assert untouched.depth_error_mm[0] == pytest.approx(untouched.depth_error_mm[1], rel=1e-4)
    assert untouched.nll is not None
    assert untouched.nll[0] == pytest.approx(untouched.nll[1], abs=1e-3)
    assert untouched.inside_90 is not None
    assert 0.7 < untouched.inside_90[0] <= 1, "positions are drawn from the predictions"
    assert change.images == 40
    assert change.depth_error_mm[0] == untouched.depth_error_mm[0]
    assert change.nll is not None
    assert change.nll[1] != change.nll[0], "int8 rounds"
    given = {"image": images[:5], "f": f[:5].numpy()}
    for value in openvino_outputs(after.SerializeToString(), given):
        assert np.isfinite(value).all()
