"""Eight views of held-out samples: `predict` records those of a finished run once, if its data set is there."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import phd_exp as package
from phd_exp.build import build_source
from phd_exp.config import check
from phd_exp.evaluation.parquet import read_table
from phd_exp.records.runs import RunFolder
from phd_exp.training import tables
from tests.support.recorded import once, status_of

PREDICT = ("predict", "run=run", "views=8", "coverage=0.5", "image=photo.png", "f=500")


@pytest.fixture
def run(run_in: Callable, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    made = once(tmp_path_factory, "run without eight views", lambda path: run_in(path, "trainer.max_epochs=1"))
    Image.fromarray(np.full((64, 64, 3), 99, np.uint8)).save(tmp_path / "photo.png")
    return RunFolder(Path(shutil.copytree(made, tmp_path / "run")))


def test_they_are_recorded_on_request_once_and_like_those_of_a_training(phd_exp: Callable, run: RunFolder) -> None:
    file, results = run.eight_views["held_out"], run.results()
    plain = phd_exp(*(word for word in PREDICT if not word.startswith("coverage")))
    assert (plain.status, plain.err, file.exists()) == (0, "", False), "nothing needs them"
    outcome = phd_exp(*PREDICT)
    assert outcome.status == 0, outcome.err
    (line,) = outcome.err.splitlines()
    assert line.endswith("eight_views_held_out.parquet: recording the eight views of 4 held-out samples, once")
    assert json.loads(outcome.out)["region"]["held_out_samples"] == 2
    again = phd_exp(*PREDICT)
    assert (again.status, again.err, again.out) == (0, "", outcome.out)
    assert (run.results(), run.eight_views["test"].exists()) == (results, False)
    by_predict, config = read_table(file), check(run.config())
    file.unlink()
    tables.record_eight_views(run, config, build_source(config.data))  # as evaluation.eight_views=true does
    for name, column in read_table(file).items():
        np.testing.assert_array_equal(by_predict[name], column)
    assert "eight_views/nll" in run.results()


def test_an_unfinished_run_is_not_recorded(phd_exp: Callable, run: RunFolder) -> None:
    status_of(run, state="interrupted")
    outcome = phd_exp(*PREDICT)
    assert outcome.status == 1
    assert "evaluation.eight_views=true" in outcome.err.splitlines()[-1]
    assert not run.eight_views["held_out"].exists()


@pytest.mark.parametrize(("gone", "said"), [(True, "no data set here"), (False, "not those of handmade now")])
def test_another_data_set_or_none_is_one_line(phd_exp: Callable, run: RunFolder, gone: bool, said: str) -> None:
    config = run.config()
    root = Path("renders").absolute()
    if not gone:
        shutil.copytree(config["data"]["root"], root)
        lines = (root / "handmade/train/metadata.jsonl").read_text().splitlines()
        changed = [json.dumps(json.loads(line) | {"z": 4.0}) for line in lines]
        (root / "handmade/train/metadata.jsonl").write_text("\n".join(changed) + "\n")
    config["data"]["root"] = str(root)
    run.write_config(config)
    assert said in phd_exp(*PREDICT).error
    assert not run.eight_views["held_out"].exists()
    with pytest.raises(Exception, match=r"repeat the command of the training with evaluation\.eight_views=true"):
        package.load(run.path, views=8, recalibrate=True)
