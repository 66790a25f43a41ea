"""Without the packages of the extras each verb works, or names the extra that it lacks on one line."""

import json
import subprocess
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.bad_input.place import HANDMADE, LEARN, ONE, Place

PACKAGES = {
    "train": ("hydra", "omegaconf", "lightning", "wandb", "torchmetrics", "torchvision"),
    "render": ("bpy",),
    "report": ("matplotlib", "plotly", "jinja2"),
    "launchers": ("joblib", "submitit", *(f"hydra_plugins.hydra_{name}_launcher" for name in ("joblib", "submitit"))),
    "export": ("onnx", "onnxscript", "onnxruntime"),
    "search": ("optuna",),
    "loggers": ("tensorboard", "tensorboardX", "mlflow"),
    "timm": ("timm",),
    "video": ("av",),
    "ros": ("rosbags",),
    "rerun": ("rerun",),
    "ray": ("ray", "hydra_plugins.hydra_ray_launcher"),
}
OTHERS = (*LEARN, "runs=others")
SMALLEST = (
    *HANDMADE, "data.variant=new", "data.n_train=1", "data.n_held_out=0", "data.n_test=1", "data.batch_size=1",
)  # fmt: skip
WORKS: dict[str, tuple[str, ...]] = {"report": ("report",), "train": OTHERS, "predict": ONE}
"""The first two lack pictures, which they say."""
LACKS: dict[str, tuple[tuple[str, ...], ...]] = {
    "train": (OTHERS, ("render", *SMALLEST), ("search", "space.yaml", "trials=1"), ("-m", *OTHERS, "seed=1,2")),
    "render": (("render", *SMALLEST), (*SMALLEST, "logger=none")),
    "report": ((*ONE, "out=pictures"),),
    "launchers": (
        ("-m", *OTHERS, "seed=1,2", "hydra/launcher=joblib"),
        ("-m", *OTHERS, "hydra/launcher=submitit_local"),
    ),
    "export": (("export", "run=RUN"),),
    "search": (("search", "space.yaml", "trials=1", *OTHERS),),
    "loggers": ((*LEARN, "runs=a", "logger=tensorboard"), (*LEARN, "runs=b", "logger=mlflow")),
    "video": (("track", "run=RUN", "video=clip.mp4", "f=300"),),
    "ros": ((*ONE, "out=a.mcap"), ("track", "run=RUN", "folder=a.mcap")),
    "rerun": ((*ONE, "view=a.rrd"),),
    "timm": ((*LEARN, "runs=c", "backbone=imagenet"),),
    "ray": (("-m", *OTHERS, "seed=1,2", "hydra/launcher=ray"),),
}
WITHOUT = """
import contextlib, importlib.metadata, io, json, sys
commands, absent = json.loads(sys.argv.pop())
sys.modules.update(dict.fromkeys(absent))
found = importlib.metadata.Distribution.from_name

def from_name(name):
    if name.lower() in absent:
        raise importlib.metadata.PackageNotFoundError(name)
    return found(name)

importlib.metadata.Distribution.from_name = from_name
from phd_exp.__main__ import main
for words in commands:
    streams = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
        status = main(words)
    print(json.dumps([status, *(stream.getvalue() for stream in streams)]))
"""


def test_the_table_has_every_extra() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert {*PACKAGES, "dev"} == set(project["optional-dependencies"])
    assert PACKAGES.keys() == LACKS.keys()


@pytest.fixture
def outcomes(place: Place) -> Callable[..., list[tuple[int, str, str]]]:
    """Run commands without packages: the status, output and errors of each.

    In a new process, because this process has already imported some of these packages.
    """
    place.put("space.yaml", "space: {}\n")

    def outcomes(commands: Sequence[Sequence[str]], absent: Sequence[str]) -> list[tuple[int, str, str]]:
        words = [[*map(place.named, command)] for command in commands]
        code = [sys.executable, "-c", WITHOUT, json.dumps([words, absent])]
        answer = subprocess.run(code, capture_output=True, text=True, cwd=place.root)
        assert answer.returncode == 0, answer.stderr
        return [json.loads(line) for line in answer.stdout.splitlines()]

    return outcomes


def require_lacks(extra: str, outcome: tuple[int, str, str]) -> None:
    """Fail unless one line names the extra."""
    status, _, err = outcome
    assert status in (1, 2), err
    (line,) = err.splitlines()
    assert line.startswith("error: "), line
    assert f"pip install 'phd_exp[{extra}]'" in line


def test_a_prediction_needs_no_extra(outcomes: Callable[..., Any]) -> None:
    commands = [ONE, *LACKS["train"], ("predict", "--help"), ("train", "--help")]
    absent = [name for names in PACKAGES.values() for name in names]
    (status, out, err), *others = outcomes(commands, absent)
    assert (status, err) == (0, "")
    assert "covariance" in json.loads(out)
    for outcome in others[: len(LACKS["train"])]:
        require_lacks("train", outcome)
    assert [status for status, *_ in others[len(LACKS["train"]) :]] == [0, 0]


@pytest.mark.slow
def test_without_the_packages_of_all_other_extras(outcomes: Callable[..., Any]) -> None:
    lacking = {extra: commands for extra, commands in LACKS.items() if extra != "train"}
    commands = [*WORKS.values(), *(words for several in lacking.values() for words in several)]
    absent = [name for extra, names in PACKAGES.items() if extra != "train" for name in names]
    found = dict(zip(commands, outcomes(commands, absent), strict=True))
    for verb, words in WORKS.items():
        status, out, err = found[words]
        assert (status, err) == (0, ""), (verb, err)
        assert ("pip install 'phd_exp[report]'" in out) == (verb != "predict"), (verb, out)
    assert "tables: report/tables" in found[WORKS["report"]][1]
    for extra, several in lacking.items():
        for words in several:
            require_lacks(extra, found[words])
