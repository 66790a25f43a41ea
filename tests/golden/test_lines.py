"""The lines of `predict`, `fuse` and `track`, and the outputs of exported graphs, of networks of fixed weights."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.golden.conftest import F, boxed, lines, photograph, placed

STRONG = (
    "recipe=strong", "backbone.width=8", "backbone.stride=4", "backbone.channels=4", "backbone.points=2",
    "recipe.hidden=8",
)  # fmt: skip
LENS = """image_width: 160
image_height: 120
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 80, 0, 500, 60, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 0.05, 0.001, -0.001, 0]}
"""


def test_lines_of_predict(golden: Callable, phd_exp: Callable, network: Callable, tmp_path: Path) -> None:
    """Boxes and whole images, a lens, eight views of an ensemble, a baseline, and a density by its closest one."""
    some = [boxed(placed(number)) for number in range(6)]
    some[1] |= {"fx": F, "fy": 1.02 * F, "cx": 82.0, "cy": 59.0}
    del some[1]["f"]
    folder = f"folder={photograph(tmp_path / 'some', some)}"
    few = f"folder={photograph(tmp_path / 'few', [boxed(placed(number)) for number in range(6, 9)])}"
    (lens := tmp_path / "lens.yaml").write_text(LENS)
    one, other = network("one", *STRONG), network("other", *STRONG)
    image = (f"image={tmp_path / 'few' / '00.png'}", f"camera={lens}", "box=20,10,130,110")
    made = {
        "density": phd_exp("predict", f"run={one}", folder),
        "lens": phd_exp("predict", f"run={one}", *image, "margin=1.2"),
        "ensemble": phd_exp("predict", f"run={one},{other}", "views=8", few),
        "baseline": phd_exp("predict", f"run={network('point', 'model=mae_logz')}", few),
        "rounded": phd_exp("predict", f"run={network('rounded', 'model=rounded_t')}", few),
        "mixture": phd_exp("predict", f"run={network('parts', 'model=gaussian_mixture')}", few),
    }
    golden("predict", {f"{name}.jsonl": lines(outcome) for name, outcome in made.items()})


def test_lines_of_fuse(golden: Callable, phd_exp: Callable, network: Callable, tmp_path: Path) -> None:
    """Three cameras around each of three positions, and the same on a plane."""
    run = f"run={network('one', *STRONG)}"
    several = []
    for scene in range(3):
        world = placed(scene)
        for view, angle in enumerate((0.0, 0.6, -0.5)):
            seen = placed(scene if view == 0 else 3 * scene + view)
            half, (c, s) = angle / 2, (np.cos(angle), np.sin(angle))
            R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
            shift = [seen[k] for k in "xyz"] - R @ [world[k] for k in "xyz"]
            pose = {"rotation": [np.cos(half), 0.0, np.sin(half), 0.0], "translation": shift.tolist()}
            several.append(boxed(seen) | {"scene": scene, "pose": pose})
    folder = f"folder={photograph(tmp_path / 'several', several)}"
    made = {"cameras": phd_exp("fuse", run, folder), "plane": phd_exp("fuse", run, folder, "plane=0,0.5,-1,-3.6")}
    golden("fuse", {f"{name}.jsonl": lines(outcome) for name, outcome in made.items()})


def test_lines_of_track(golden: Callable, phd_exp: Callable, network: Callable, tmp_path: Path) -> None:
    """A ball that passes by."""
    steps = [(k, {"time": k / 20, "track": "ball"}) for k in range(14)]
    moving = [{"f": F, "x": 0.02 * k - 0.1, "y": 0.01 * k - 0.06, "z": 3.3 + 0.03 * k} | known for k, known in steps]
    folder = photograph(tmp_path / "moving", map(boxed, moving))
    words = (f"run={network('one', *STRONG)}", f"folder={folder}", "depth_time=2", "speed=0.5", "lag=5")
    golden("track", {"path.jsonl": lines(phd_exp("track", *words))})


@pytest.mark.slow
@pytest.mark.parametrize(("name", "words"), [("one", STRONG), ("point", ("model=mae_logz",))])
def test_outputs_of_exported_graphs(
    golden: Callable, phd_exp: Callable, network: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    name: str, words: tuple[str, ...],
) -> None:  # fmt: skip
    onnxruntime = pytest.importorskip("onnxruntime")
    # a shape that is checked is a fixed one in a graph
    monkeypatch.setattr("jaxtyping.config.jaxtyping_disable", True)
    outcome = phd_exp("export", f"run={network(name, *words)}", f"out={tmp_path / 'network.onnx'}")
    assert outcome.status == 0, outcome.err
    folder = photograph(tmp_path / "square", [placed(k, f=250.0, across=0.1) for k in range(3)], (48, 48))
    images = np.stack([np.asarray(Image.open(file)) for file in sorted(folder.glob("*.png"))])
    session = onnxruntime.InferenceSession(tmp_path / "network.onnx", providers=["CPUExecutionProvider"])
    given = {"image": images, "f": np.full(3, 250.0, np.float32)}
    given = {value.name: given[value.name] for value in session.get_inputs()}
    outputs = zip(session.get_outputs(), session.run(None, given), strict=True)
    golden(f"graphs/{name}", {"outputs.json": {output.name: value.tolist() for output, value in outputs}})
