"""Any content of a file or of the command line causes a UserError or a result, never another exception."""

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from phd_exp.cli import train
from phd_exp.cli.frame import run_verb
from phd_exp.cli.jobs import Job, launch
from phd_exp.config import RunConfig, check, check_render
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import UserError
from phd_exp.records.own_images import annotations, detections_in
from phd_exp.records.runs import RunFolder, RunStatus
from phd_exp.reports.report import read_report
from tests.support.foreign import WRITERS

EXAMPLES = [20, pytest.param(2000, marks=[pytest.mark.slow, pytest.mark.timeout(1200)])]
pytestmark = pytest.mark.parametrize("examples", EXAMPLES)


def holds_for(examples: int, law: Callable[..., None], *strategies: Any) -> None:
    """Check a law on so many examples, always the same ones."""
    settings(
        max_examples=examples, derandomize=True, deadline=None, database=None,
        suppress_health_check=[HealthCheck.too_slow],
    )(given(*strategies)(law))()  # fmt: skip


SCALARS = (
    st.none() | st.booleans() | st.integers(min_value=-(10**400), max_value=10**400)
    | st.floats() | st.text(max_size=20)
    | st.sampled_from(["", "nan", "../x", "/etc/passwd", "a\0b", "${oc.env:HOME}", "???", "null", "1e999", "\x1b[2J"])
)  # fmt: skip
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4)
    | st.dictionaries(st.text(max_size=8) | SCALARS.map(str), inner, max_size=4),
    max_leaves=8,
)  # fmt: skip


def spoiled(good: Any) -> Any:
    """A good document of which one or two values, at any depth, are replaced."""

    def changed(node: Any) -> Any:
        if isinstance(node, list) and node:
            return st.integers(0, len(node) - 1).flatmap(
                lambda place: changed(node[place]).map(lambda value: [*node[:place], value, *node[place + 1 :]])
            )
        if not isinstance(node, dict) or not node:
            return VALUES
        return st.sampled_from(sorted(node, key=str)).flatmap(
            lambda key: (changed(node[key]) | VALUES).map(lambda value: {**node, key: value})
        )

    return changed(good) | changed(good).flatmap(changed)


def written(*goods: Any, dump: Callable[[Any], str] = json.dumps) -> Any:
    """The bytes of spoiled documents, also cut off, and any other bytes."""
    texts = st.one_of(*(spoiled(good) for good in goods), VALUES).map(dump).map(str.encode)
    cut = texts.flatmap(lambda text: st.integers(0, len(text)).map(lambda end: text[:end]))
    return texts | cut | st.binary(max_size=200)


LINE = {"file_name": "a.png", "f": 300.0, "box": [0, 0, 9, 9], "x": 0.0, "y": 0.0, "z": 3.0}


@pytest.mark.parametrize("name", [*WRITERS, "lines"])
def test_annotations_of_images(tmp_path: Path, name: str, examples: int) -> None:
    folder = tmp_path / "test"
    folder.mkdir()
    (folder / "metadata.jsonl").write_text(json.dumps(LINE))
    files = [folder / "metadata.jsonl"] if name == "lines" else annotations(WRITERS[name](tmp_path / "other/test"))[0]
    folder = folder if name == "lines" else tmp_path / "other/test"
    goods = {file: file.read_bytes() for file in files if file.suffix in (".json", ".jsonl")}

    def law(data: st.DataObject) -> None:
        file = data.draw(st.sampled_from(sorted(goods)))
        file.write_bytes(data.draw(written(json.loads(goods[file]))))
        with suppress(UserError):
            for detection in detections_in(folder):
                assert detection.file.resolve().is_relative_to(folder.resolve())
                with suppress(UserError):
                    detection.optics(100, 100)
                    detection.box(100, 100)
        file.write_bytes(goods[file])

    holds_for(examples, law, st.data())


STATUS = RunStatus(state="finished", started=1.0, versions={}, git_commit=None, data_manifest=None, machine="x")
RECORDS = st.fixed_dictionaries(
    {
        "status.json": written(STATUS.model_dump(mode="json")),
        "config.yaml": written({"data": {"name": "a"}}, dump=yaml.safe_dump),
        "metrics.jsonl": written({"epoch": 0, "step": 1, "test/nll": 0.5}),
        "results.json": written({"test/nll": 0.5}),
        "constants.json": written({"mu_z0": 1.0, "D": 1.0, "z_centre": 1.0, "constant_f": 1.0}),
        "predictions.parquet": st.binary(max_size=100),
    }
)


def test_records(tmp_path: Path, composed: Callable[..., dict[str, Any]], examples: int) -> None:
    run, data = RunFolder(tmp_path / "runs/smoke/default/probabilistic/seed0"), DatasetFolder(tmp_path / "data")
    for folder in (run.path, data.split_folder("test")):
        folder.mkdir(parents=True)

    def law(contents: dict[str, bytes], lines: bytes, manifest: bytes, config: Any) -> None:
        for name, content in contents.items():
            (run.path / name).write_bytes(content)
        data.metadata_path("test").write_bytes(lines)
        data.manifest_path.write_bytes(manifest)
        reads = (run.status, run.config, run.results, run.constants, run.metrics, lambda: check(run.config()))
        sets = (
            lambda: data.manifest,
            lambda: data.records("test"),
            lambda: check(config),
            lambda: check_render(config),
        )
        for read in (*reads, *sets):
            with suppress(UserError):
                read()
        assert len(read_report(tmp_path / "runs").runs) == 1

    sections = st.dictionaries(st.sampled_from(sorted(RunConfig.model_fields)), VALUES, max_size=12)
    configs = spoiled(composed("preset=smoke", "logger=none")) | sections
    holds_for(examples, law, RECORDS, written(LINE), written({"splits": {}}), configs)


WORDS = st.sampled_from(
    ["seed", "data", "data.n_train", "data.f_range", "model", "model.head", "optimizer.lr", "+x", "~data", "++seed",
     "loss._target_", "trainer", "hydra.job.name", "preset", "-m", "--cfg", "experiment", "data@x", "data.mesh"]
) | st.text(max_size=6)  # fmt: skip
MEANINGS = st.sampled_from(
    ["0", "null", "[1,2]", "{a:1}", "1,2", "range(0,3)", "glob(*)", "${x}", "${seed}", "${oc.env:NO}", "'", '"', "[",
     "}", "choice(a,b)", "1e999", "nan", "job", "sort(3,2)", "interval(0,1)", "a\\,b", "", "os.system"]
) | st.text(max_size=8)  # fmt: skip
OVERRIDES = st.lists(
    st.tuples(WORDS, st.sampled_from(["=", "", "=="]), MEANINGS).map("".join), max_size=3
)  # fmt: skip


def test_overrides(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, examples: int
) -> None:
    """The configuration is composed and checked, but nothing is run."""
    monkeypatch.chdir(tmp_path)

    def task(config: dict[str, Any], overrides: list[str], cores: int) -> None:
        train.run_name(check(config), overrides)

    def law(words: list[str]) -> None:
        capfd.readouterr()
        typed = ["preset=smoke", "logger=none", *words]
        status = run_verb(lambda line: launch(Job(task, train.standing), line), typed)
        out, err = capfd.readouterr()
        assert status in (0, 1, 2), words
        assert "Traceback" not in out + err, (words, err)
        if status:
            assert all(line.startswith("error: ") for line in err.splitlines()), (words, err)
            assert err

    holds_for(min(examples, 500), law, OVERRIDES)
