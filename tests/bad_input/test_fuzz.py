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
from phd_exp.records.detections import DetectionLine
from phd_exp.records.errors import UserError
from phd_exp.records.own_images import annotations, detections_in
from phd_exp.records.runs import RunFolder, RunStatus
from phd_exp.records.scenes import SampleRecord
from phd_exp.reports.report import read_report
from tests.support.foreign import WRITERS

EXAMPLES = [20, pytest.param(2000, marks=[pytest.mark.slow, pytest.mark.timeout(1200)])]
each_number_of_examples = pytest.mark.parametrize("examples", EXAMPLES)


def holds_for(examples: int, law: Callable[..., None], *strategies: Any) -> None:
    """Check a law on so many examples."""
    settings(
        max_examples=examples, derandomize=True, deadline=None, database=None,
        suppress_health_check=[HealthCheck.too_slow],
    )(given(*strategies)(law))()  # fmt: skip


SCALARS = (
    st.none() | st.booleans() | st.integers() | st.integers(min_value=-(10**400), max_value=10**400)
    | st.floats() | st.text(max_size=20)
    | st.sampled_from(["", "nan", "../x", "/etc/passwd", "a\0b", "${oc.env:HOME}", "???", "null", "1e999", "\x1b[2J"])
)  # fmt: skip
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4)
    | st.dictionaries(st.text(max_size=8) | SCALARS.map(str), inner, max_size=4),
    max_leaves=8,
)  # fmt: skip


def objects(fields: Any) -> Any:
    """Mappings with these keys, some others, and any values."""
    return st.dictionaries(st.sampled_from(sorted(fields)) | st.text(max_size=8), VALUES, max_size=12)


def spoiled(good: dict[str, Any]) -> Any:
    """A good mapping of which a few values, at any depth, are replaced."""

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


def dumped(value: Any) -> str:
    return json.dumps(value)


LINE = {"file_name": "a.png", "f": 300.0, "box": [0, 0, 9, 9], "x": 0.0, "y": 0.0, "z": 3.0}
TEXTS = (spoiled(LINE) | objects(DetectionLine.model_fields) | VALUES).map(dumped)
BYTES = st.binary(max_size=200) | TEXTS.map(str.encode) | TEXTS.flatmap(
    lambda text: st.integers(0, len(text)).map(lambda end: text[:end].encode())
)  # fmt: skip


@each_number_of_examples
@pytest.mark.parametrize("name", WRITERS)
def test_other_formats(tmp_path: Path, name: str, examples: int) -> None:
    """Files whose JSON or text is spoiled at any depth."""
    folder = WRITERS[name](tmp_path / "test")
    files = annotations(folder)[0]
    goods = {file: file.read_bytes() for file in files}

    def law(data: st.DataObject) -> None:
        file = data.draw(st.sampled_from(files))
        text = goods[file].decode()
        spoilt = spoiled(json.loads(text)).map(dumped) if file.suffix == ".json" else changed_words(text)
        file.write_bytes(data.draw(BYTES | spoilt.map(str.encode)))
        with suppress(UserError):
            for detection in detections_in(folder):
                assert detection.file.resolve().is_relative_to(folder.resolve())
        file.write_bytes(goods[file])

    holds_for(examples, law, st.data())


def changed_words(text: str) -> Any:
    """A text of which one word is replaced."""
    words = text.split(" ")
    places, others = (
        st.integers(0, len(words) - 1),
        st.sampled_from(["", "nan", "1e999", "-1", "x", "0", "9" * 400, "\n"]),
    )
    return st.builds(lambda place, word: " ".join([*words[:place], word, *words[place + 1 :]]), places, others)


STATUS = RunStatus(state="finished", started=1.0, versions={}, git_commit=None, data_manifest=None, machine="x")
RECORDS = st.fixed_dictionaries(
    {
        "status.json": (spoiled(STATUS.model_dump(mode="json")) | VALUES).map(dumped).map(str.encode) | BYTES,
        "config.yaml": VALUES.map(lambda value: yaml.safe_dump(value).encode()) | BYTES,
        "metrics.jsonl": st.lists(objects(["epoch", "step", "test/nll"]).map(dumped), max_size=3).map(
            lambda lines: "".join(f"{line}\n" for line in lines).encode()
        ),
        "results.json": BYTES,
        "constants.json": BYTES,
        "predictions.parquet": st.binary(max_size=100),
    }
)


@each_number_of_examples
def test_metadata(tmp_path: Path, examples: int) -> None:
    def law(content: bytes) -> None:
        (tmp_path / "metadata.jsonl").write_bytes(content)
        with suppress(UserError):
            for detection in detections_in(tmp_path):
                assert detection.file.resolve().is_relative_to(tmp_path.resolve())
                with suppress(UserError):
                    detection.focal_lengths_and_centre(100, 100)
                    detection.box(100, 100)

    holds_for(examples, law, BYTES)


@each_number_of_examples
def test_run_records(tmp_path: Path, examples: int) -> None:
    folder = RunFolder(tmp_path / "runs/smoke/default/probabilistic/seed0")
    folder.path.mkdir(parents=True)

    def law(contents: dict[str, bytes]) -> None:
        for name, content in contents.items():
            (folder.path / name).write_bytes(content)
        for read in (folder.status, folder.config, folder.results, folder.constants, folder.metrics):
            with suppress(UserError):
                read()
        assert len(read_report(tmp_path / "runs").runs) == 1
        with suppress(UserError):
            check(folder.config())

    holds_for(examples, law, RECORDS)


@each_number_of_examples
def test_configurations(composed: Any, examples: int) -> None:
    good = composed("preset=smoke", "logger=none")

    def law(data: st.DataObject) -> None:
        config = data.draw(spoiled(good) | objects(RunConfig.model_fields))
        for checked in (check, check_render):
            with suppress(UserError):
                checked(config)

    holds_for(examples, law, st.data())


@each_number_of_examples
def test_data_sets(tmp_path: Path, examples: int) -> None:
    folder = DatasetFolder(tmp_path)
    folder.split_folder("test").mkdir()

    def law(lines: list[bytes], manifest: bytes) -> None:
        folder.metadata_path("test").write_bytes(b"\n".join(lines))
        folder.manifest_path.write_bytes(manifest)
        for read in (lambda: folder.manifest, lambda: folder.records("test")):
            with suppress(UserError):
                read()
        for text in lines:
            with suppress(ValueError):
                SampleRecord.model_validate_json(text)

    holds_for(examples, law, st.lists(BYTES, max_size=2), BYTES)


WORDS = st.sampled_from(
    ["seed", "data", "data.n_train", "data.f_range", "model", "model.head", "optimizer.lr", "+x", "~data", "++seed",
     "loss._target_", "trainer", "hydra.job.name", "preset", "-m", "--cfg", "experiment", "data@x", "runs"]
) | st.text(max_size=6)  # fmt: skip
MEANINGS = st.sampled_from(
    ["0", "null", "[1,2]", "{a:1}", "1,2", "range(0,3)", "glob(*)", "${x}", "${seed}", "${oc.env:NO}", "'", '"', "[",
     "}", "choice(a,b)", "1e999", "nan", "job", "sort(3,2)", "interval(0,1)", "a\\,b", "", "os.system"]
) | st.text(max_size=8)  # fmt: skip
OVERRIDES = st.lists(
    st.tuples(WORDS, st.sampled_from(["=", "", "=="]), MEANINGS).map("".join), max_size=3
)  # fmt: skip


@each_number_of_examples
def test_overrides(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, examples: int
) -> None:
    """The configuration is composed and checked, but nothing is run."""
    monkeypatch.chdir(tmp_path)

    def task(config: dict[str, Any], overrides: list[str], cores: int) -> None:
        train.run_name(check(config), overrides)

    def verb(words: list[str]) -> int:
        return launch(Job(task, train.standing), words)

    def law(words: list[str]) -> None:
        capfd.readouterr()
        try:
            status = run_verb(verb, ["preset=smoke", "logger=none", *words])
        except SystemExit as end:  # --version and the like
            status = end.code
        out, err = capfd.readouterr()
        assert status in (0, 1, 2), words
        assert "Traceback" not in out + err, (words, err)
        if status:
            assert all(line.startswith("error: ") for line in err.splitlines()), (words, err)
            assert err

    holds_for(min(examples, 500), law, OVERRIDES)
