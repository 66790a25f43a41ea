"""`python -m phd_exp search SPACE.yaml`: Optuna over resumable runs, judged by their held-out samples."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from warnings import catch_warnings

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, RangeSweep
from hydra.errors import HydraException
from pydantic import BaseModel, ConfigDict, Field

from phd_exp.cli.arguments import Arguments
from phd_exp.cli.frame import print_errors
from phd_exp.cli.jobs import composed
from phd_exp.cli.paths import quoted
from phd_exp.cli.starts import checked_start
from phd_exp.cli.train import run_name, task
from phd_exp.config.targets import TrainingTarget, build
from phd_exp.records.errors import ConfigError, RunError, UserError, gist
from phd_exp.records.files import make_folder, read_plain, write_atomic
from phd_exp.records.parsing import parse_yaml
from phd_exp.records.processes import held, usable_cores
from phd_exp.records.searches import RECORD, SEARCHES, Search, Trial, TrialState

if TYPE_CHECKING:  # optional
    import optuna


SEQUENCES = ("GridSampler", "QMCSampler")
"""Samplers whose seed determines the values of all trials; that of the others is increased with each trial."""


class SearchArguments(Arguments):
    """The keys of a search; all others are overrides of its runs."""

    trials: Annotated[int, Field(ge=1, le=100_000)] = 20
    """the number of trials, including those of an earlier command"""
    config_dir: Path | None = None
    """a folder with further choices, like --config-dir of train"""


class Space(BaseModel):
    """The file of a search: overrides of all its runs, the values to try, and parts of Optuna."""

    model_config = ConfigDict(extra="forbid")

    space: dict[str, Any]
    overrides: list[str] = Field(default_factory=list)
    sampler: TrainingTarget = {"_target_": "optuna.samplers.TPESampler", "seed": 0}
    pruner: TrainingTarget = {"_target_": "optuna.pruners.MedianPruner"}


def main(words: list[str]) -> int:
    """Search; returns the exit status. The same command resumes an interrupted search."""
    if not words or "=" in words[0]:
        raise ConfigError("search: expected SPACE.yaml first; see `python -m phd_exp search --help`")
    if find_spec("optuna") is None:
        raise ConfigError("search needs Optuna: `pip install 'phd_exp[search]'`")
    file, keys = Path(words[0]), SearchArguments.model_fields
    ours = [word for word in words[1:] if word.partition("=")[0] in keys]
    arguments = SearchArguments.parsed("search", ours)
    try:
        space = Space.model_validate(parse_yaml(read_plain(file).decode()), context={"trust": None})
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: {gist(error)}; expected `space`, as in docs/guides/search.md") from None
    given = [*space.overrides, *(word for word in words[1:] if word not in ours)]
    fixed = [*quoted(given), "evaluation.held_out=true"]
    config = checked_start(composed(fixed, arguments.config_dir), fixed)
    if config.data.n_held_out == 0:
        raise ConfigError("data.n_held_out: got 0; a search is judged by held-out samples, expected at least 1")
    folder = config.runs / SEARCHES / file.stem
    make_folder(folder)
    with held(folder / ".lock") as free:
        if not free:
            raise RunError(f"{folder}: another process works on this search; wait for it or stop it")
        _Search(space, fixed, arguments.config_dir, folder).run(arguments.trials)
    return 0


def distributions(space: Mapping[str, Any]) -> dict[str, Any]:
    """Optuna's distributions of values in Hydra's grammar of sweeps: choice(...), range(...), interval(...).

    `int(interval(...))` is of whole numbers; `tag(log, interval(...))` searches the logarithm.

    Raises ConfigError for anything else.
    """
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    found: dict[str, Any] = {}
    for key, text in space.items():
        try:
            override = OverridesParser.create().parse_override(f"{key}={text}")
            value: Any = override.value()
            if isinstance(value, ChoiceSweep):
                found[key] = CategoricalDistribution(list(override.sweep_string_iterator()))
            elif isinstance(value, IntervalSweep):
                ends: Any = (value.start, value.end)
                kind: Any = IntDistribution if all(isinstance(end, int) for end in ends) else FloatDistribution
                found[key] = kind(*ends, log="log" in value.tags)
            elif isinstance(value, RangeSweep):
                places = [int(place) for place in override.sweep_string_iterator()]
                found[key] = IntDistribution(places[0], places[-1], step=int(value.step))
            else:
                raise ValueError("expected choice(A,B), range(FIRST,END) or interval(LOW,HIGH)")
        except (HydraException, ValueError, TypeError, IndexError) as error:
            raise ConfigError(f"space.{key}: got {text!r}; {gist(error)}") from None
    return found


class _Search:
    """A study of Optuna whose trials are runs."""

    def __init__(self, space: Space, fixed: list[str], config_dir: Path | None, folder: Path) -> None:
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.fixed, self.config_dir, self.folder = fixed, config_dir, folder
        self.space = distributions(space.space)
        self.study = optuna.create_study(
            storage=f"sqlite:///{folder.absolute() / 'study.db'}",
            study_name=folder.name,
            pruner=build(space.pruner),
            load_if_exists=True,
        )
        self.sampler = space.sampler
        asked = {"space": space.space, "overrides": fixed}
        if self.study.user_attrs.get("asked", asked) != asked:
            raise RunError(
                f"{folder}: holds a search of {self.study.user_attrs['asked']}; rename the file, or that folder"
            )
        self.study.set_user_attr("asked", asked)

    def run(self, trials: int) -> None:
        """Run trials until there are as many; those that were interrupted are resumed first."""
        import optuna

        running = self.study.get_trials(deepcopy=False, states=[optuna.trial.TrialState.RUNNING])
        begun = [optuna.trial.Trial(self.study, trial._trial_id) for trial in running]
        while begun or len(self.study.trials) < trials:
            trial = begun.pop() if begun else self._ask()
            self._run_trial(trial, trials)
            self._write()
        search = self._write()
        best = search.best
        if best is None:
            raise RunError(f"{self.folder}: no trial has finished; each line above says why")
        words = " ".join(f"{key}={value}" for key, value in best.overrides.items())
        score = f"{search.objective} {best.value:.4g}"
        print(f"{self.folder}: best of {len(self.study.trials)} trials: {words}: {score}, {best.run}")

    def _ask(self) -> "optuna.Trial":
        """The next trial; its values follow from those of the trials before, also in a resumed search."""
        sampler, number = dict(self.sampler), len(self.study.trials)
        if isinstance(sampler.get("seed"), int) and not sampler["_target_"].endswith(SEQUENCES):
            sampler["seed"] += number
        self.study.sampler = build(sampler)
        return self.study.ask(self.space)

    def _run_trial(self, trial: "optuna.Trial", trials: int) -> None:
        import optuna

        from phd_exp.training.pruning import Pruned, Pruning, held_out_score

        own = [f"{key}={value}" for key, value in trial.params.items()]
        overrides = [*self.fixed, *own]
        print(f"trial {trial.number + 1}/{trials}: {' '.join(own)}", flush=True)
        config = composed(overrides, self.config_dir)
        checked = checked_start(config, overrides)
        run = run_name(checked, overrides).folder(checked.runs)
        trial.set_user_attr("run", str(run))
        try:
            task(config, overrides, usable_cores(), callbacks=[Pruning(trial)])
            objective, value = held_out_score(run)
            self.study.set_user_attr("objective", objective)
            self.study.tell(trial, value)
        except Pruned as pruned:
            print(f"{run}: {pruned}", flush=True)
            self.study.tell(trial, state=optuna.trial.TrialState.PRUNED)
        except UserError as error:
            self.study.tell(trial, state=optuna.trial.TrialState.FAIL)
            if isinstance(error, ConfigError):
                raise
            print_errors(str(error).splitlines())

    def _write(self) -> Search:
        """Write the record of the search."""
        from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

        try:
            with catch_warnings(action="ignore"):  # of too few trials
                importances = get_param_importances(self.study, evaluator=PedAnovaImportanceEvaluator())
        except (ValueError, RuntimeError):  # no finished trial, or all alike
            importances = {}
        states: dict[str, TrialState] = {"COMPLETE": "finished", "PRUNED": "pruned", "FAIL": "failed"}
        trials = [
            Trial(
                number=trial.number,
                state=states.get(trial.state.name, "running"),
                overrides={key: str(value) for key, value in trial.params.items()},
                run=trial.user_attrs.get("run", ""),
                value=trial.value,
            )
            for trial in self.study.trials
        ]
        objective = self.study.user_attrs.get("objective", "held_out/nll")
        search = Search(name=self.folder.name, objective=objective, trials=trials, importances=importances)
        write_atomic(self.folder / RECORD, search.model_dump_json(indent=2) + "\n")
        return search
