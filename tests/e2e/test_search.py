"""A search with Optuna over runs of a second: resumable, pruned, judged by held-out samples, shown in the report."""

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from phd_exp.evaluation.parquet import read_table
from phd_exp.records.errors import ConfigError
from phd_exp.records.runs import RunFolder
from phd_exp.records.searches import read_searches
from tests.support.own_parts import QUICK
from tests.support.recorded import status_of

optuna = pytest.importorskip("optuna", reason="needs `pip install 'phd_exp[search]'`")

from phd_exp.cli import search as verb  # noqa: E402

WORDS = ("space.yaml", "config_dir=my_conf", *QUICK[1:])
SPACE = """
space:
  optimizer.lr: tag(log, interval(0.0001, 0.1))
  backbone.width: choice(4, 8)
sampler: {_target_: optuna.samplers.RandomSampler, seed: 1}
"""


@pytest.fixture
def search(own: Callable, phd_exp: Callable, tmp_path: Path) -> Callable:
    (tmp_path / "my_conf/backbone/mine.yaml").write_text("_target_: ownnet.Mine\nwidth: 8\n")
    (tmp_path / "space.yaml").write_text(SPACE)
    return lambda *words: phd_exp("search", *WORDS, *words)


def test_values_are_those_of_hydras_sweeps() -> None:
    kinds = optuna.distributions
    space = {"a": "interval(0.5, 2)", "b": "tag(log, int(interval(1, 9)))", "c": "range(0, 10, step=5)"}
    found = verb.distributions(space | {"d": "choice(x, 3)"})
    assert found == {
        "a": kinds.FloatDistribution(0.5, 2.0),
        "b": kinds.IntDistribution(1, 9, log=True),
        "c": kinds.IntDistribution(0, 5, step=5),
        "d": kinds.CategoricalDistribution(["x", "3"]),
    }


@pytest.mark.parametrize("text", ["3", "interval(2, 1)", "glob(*)", "interval(0, 1", "range(3, 3)", [0.5, 2]])
def test_other_values_are_refused(text: Any) -> None:
    with pytest.raises(ConfigError, match=r"^space\.a: got "):
        verb.distributions({"a": text})


@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
@pytest.mark.parametrize("sampler", ["RandomSampler", "TPESampler", "QMCSampler"])
def test_a_resumed_search_tries_the_values_of_an_uninterrupted_one(
    sampler: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def tell(study: optuna.Study, trial: optuna.Trial, fixed: list[str], config_dir: Path | None) -> None:
        study.tell(trial, trial.params["a"])

    def searched(name: str, *parts: int) -> list[float]:
        (tmp_path / name).mkdir()
        for trials in parts:
            study = verb.search(space, [], None, tmp_path / name, trials)
        return [trial.params["a"] for trial in study.trials]

    monkeypatch.setattr(verb, "run_trial", tell)
    chosen = {"_target_": f"optuna.samplers.{sampler}", "seed": 0}
    space = verb.Space(space={"a": "interval(0, 1)"}, sampler=chosen, pruner={"_target_": "optuna.pruners.NopPruner"})
    whole = searched("whole", 14)
    assert len(set(whole)) == 14
    assert searched("resumed", 3, 4, 12, 14) == whole


@pytest.mark.slow
def test_the_best_trial_is_the_best_on_held_out_samples(search: Callable, phd_exp: Callable) -> None:
    outcome = search("trials=2")
    assert outcome.status == 0, outcome.err
    (found,) = read_searches(Path("runs"))
    assert [trial.state for trial in found.trials] == ["finished"] * 2
    for trial in found.trials:
        assert trial.value == pytest.approx(read_table(RunFolder(Path(trial.run)).held_out)["nll"][::2].mean())
        assert str(RunFolder(Path(trial.run)).config()["optimizer"]["lr"]) == trial.overrides["optimizer.lr"]
    assert found.best.value == min(trial.value or 0 for trial in found.trials)
    assert found.best.run in outcome.out.splitlines()[-1]
    more = search("trials=3")
    assert more.out.count("trial ") == 1
    assert "trial 3/3" in more.out
    (longer,) = read_searches(Path("runs"))
    assert len({trial.overrides["optimizer.lr"] for trial in longer.trials}) == 3, "no value is drawn again"
    assert phd_exp("report").status == 0
    page = Path("report/site/index.html").read_text()
    assert "Search space: 3 finished" in page
    assert "space: importance of keys" in page
    assert len(Path("report/tables/searches.csv").read_text().splitlines()) == 4


def test_an_interrupted_trial_is_resumed(search: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    from ownparts import Squares  # type: ignore[import-not-found]

    from phd_exp.training.pruning import Pruning

    assert Squares
    reported = Pruning.on_validation_end

    def stop(self: Pruning, trainer: object, module: object) -> None:
        reported(self, trainer, module)  # type: ignore[arg-type]
        if self.trial.number == 1:
            monkeypatch.setattr(Pruning, "on_validation_end", reported)
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(Pruning, "on_validation_end", stop)
    assert search("trials=2").status == 143
    (before,) = read_searches(Path("runs"))
    assert [trial.state for trial in before.trials] == ["finished"]
    outcome = search("trials=2")
    assert outcome.status == 0, outcome.err
    assert next(line for line in outcome.out.splitlines() if line.startswith("trial ")).startswith("trial 2/2")
    (after,) = read_searches(Path("runs"))
    assert [trial.state for trial in after.trials] == ["finished"] * 2
    assert after.trials[0] == before.trials[0]


def test_trials_without_prospects_are_pruned(search: Callable, tmp_path: Path) -> None:
    pruner = "pruner: {_target_: optuna.pruners.ThresholdPruner, upper: -100.0}"
    (tmp_path / "space.yaml").write_text(SPACE + pruner)
    outcome = search("trials=2")
    assert outcome.status == 1
    assert "no trial has finished" in outcome.err
    (found,) = read_searches(Path("runs"))
    assert [trial.state for trial in found.trials] == ["pruned", "pruned"]
    status = status_of(RunFolder(Path(found.trials[0].run)))
    assert status.state == "interrupted"
    assert "pruned after epoch 1 of 2" in str(status.error)


def test_another_space_has_another_name(search: Callable, tmp_path: Path) -> None:
    assert search("trials=1").status == 0
    (tmp_path / "space.yaml").write_text(SPACE.replace("0.1)", "0.2)"))
    outcome = search("trials=1")
    assert "holds a search of" in outcome.err
