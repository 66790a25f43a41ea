"""`python -m phd_exp search SPACE.yaml`: Optuna over resumable runs, judged by their held-out samples."""

from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from warnings import catch_warnings

from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, RangeSweep
from hydra.errors import HydraException
from pydantic import BaseModel, ConfigDict, Field

from phd_exp.cli import words
from phd_exp.cli.arguments import Arguments
from phd_exp.cli.frame import print_errors
from phd_exp.cli.jobs import composed
from phd_exp.cli.train import checked_start, run_name, task
from phd_exp.config.targets import TrainingTarget, build
from phd_exp.records.errors import ConfigError, RunError, UserError, gist
from phd_exp.records.files import make_folder, read_plain, write_atomic
from phd_exp.records.parsing import parse_yaml
from phd_exp.records.processes import held, usable_cores
from phd_exp.records.searches import RECORD, SEARCHES, Search, Trial

if TYPE_CHECKING:  # optional
    import optuna

SEQUENCES = ("GridSampler", "QMCSampler")
"""Samplers whose seed determines the values of all trials; that of the others is increased with each trial."""
STATES = {"COMPLETE": "finished", "PRUNED": "pruned", "FAIL": "failed", "RUNNING": "running"}


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


def main(line: list[str]) -> int:
    """Search; returns the exit status. The same command resumes an interrupted search."""
    if not line or "=" in line[0]:
        raise ConfigError("search: expected SPACE.yaml first; see `python -m phd_exp search --help`")
    if find_spec("optuna") is None:
        raise ConfigError("search needs Optuna: `pip install 'phd_exp[search]'`")
    file, keys = Path(line[0]), SearchArguments.model_fields
    ours = [word for word in line[1:] if word.partition("=")[0] in keys]
    arguments = SearchArguments.parsed("search", ours)
    try:
        space = Space.model_validate(parse_yaml(read_plain(file).decode()), context={"trust": None})
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: {gist(error)}; expected `space`, as in docs/guides/search.md") from None
    given = [*space.overrides, *(word for word in line[1:] if word not in ours)]
    fixed = [*words.overrides(given), "evaluation.held_out=true"]
    config = checked_start(composed(fixed, arguments.config_dir), fixed)
    if config.data.n_held_out == 0:
        raise ConfigError("data.n_held_out: got 0; a search is judged by held-out samples, expected at least 1")
    folder = config.runs / SEARCHES / file.stem
    make_folder(folder)
    with held(folder / ".lock") as free:
        if not free:
            raise RunError(f"{folder}: another process works on this search; wait for it or stop it")
        search(space, fixed, arguments.config_dir, folder, arguments.trials)
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
            override = words.parsed(f"{key}={text}")
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


def search(space: Space, fixed: list[str], config_dir: Path | None, folder: Path, trials: int) -> "optuna.Study":
    """Run trials until there are as many; those that were interrupted are resumed first. Returns the study."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    values = distributions(space.space)
    storage = f"sqlite:///{folder.absolute() / 'study.db'}"
    study = optuna.create_study(
        storage=storage, study_name=folder.name, pruner=build(space.pruner), load_if_exists=True
    )
    asked = {"space": space.space, "overrides": fixed}
    if (before := study.user_attrs.get("asked", asked)) != asked:
        raise RunError(f"{folder}: holds a search of {before}; rename the file, or that folder")
    study.set_user_attr("asked", asked)
    running = study.get_trials(deepcopy=False, states=[optuna.trial.TrialState.RUNNING])
    begun = [optuna.trial.Trial(study, trial._trial_id) for trial in running]
    while begun or len(study.trials) < trials:
        if begun:
            trial = begun.pop()
        else:  # its values follow from those of the trials before, also in a resumed search
            sampler = dict(space.sampler)
            if isinstance(sampler.get("seed"), int) and not sampler["_target_"].endswith(SEQUENCES):
                sampler["seed"] += len(study.trials)
            study.sampler = build(sampler)
            trial = study.ask(values)
        print(f"trial {trial.number + 1}/{trials}: ", end="")
        run_trial(study, trial, fixed, config_dir)
        write_record(study, folder)
    record = write_record(study, folder)
    best = record.best
    if best is None:
        raise RunError(f"{folder}: no trial has finished; each line above says why")
    chosen = " ".join(f"{key}={value}" for key, value in best.overrides.items())
    print(f"{folder}: best of {len(study.trials)} trials: {chosen}: {record.objective} {best.value:.4g}, {best.run}")
    return study


def run_trial(study: "optuna.Study", trial: "optuna.Trial", fixed: list[str], config_dir: Path | None) -> None:
    """Train the run of a trial, and tell the study its score, or that it was pruned or failed."""
    from optuna.trial import TrialState

    from phd_exp.training.pruning import Pruned, Pruning, held_out_score

    own = [f"{key}={value}" for key, value in trial.params.items()]
    print(" ".join(own), flush=True)
    overrides = [*fixed, *own]
    config = composed(overrides, config_dir)
    checked = checked_start(config, overrides)
    run = run_name(checked, overrides).folder(checked.runs)
    trial.set_user_attr("run", str(run))
    try:
        task(config, overrides, usable_cores(), callbacks=[Pruning(trial)])
        objective, value = held_out_score(run)
        study.set_user_attr("objective", objective)
        study.tell(trial, value)
    except Pruned as pruned:
        print(f"{run}: {pruned}", flush=True)
        study.tell(trial, state=TrialState.PRUNED)
    except UserError as error:
        study.tell(trial, state=TrialState.FAIL)
        if isinstance(error, ConfigError):
            raise
        print_errors(str(error).splitlines())


def write_record(study: "optuna.Study", folder: Path) -> Search:
    """Write all trials of a search, and the importance of each key, where a report finds them."""
    from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

    try:
        with catch_warnings(action="ignore"):  # of too few trials
            importances = get_param_importances(study, evaluator=PedAnovaImportanceEvaluator())
    except (ValueError, RuntimeError):  # no finished trial, or all alike
        importances = {}
    trials = [
        Trial(
            number=trial.number,
            state=STATES[trial.state.name],  # type: ignore[arg-type]
            overrides={key: str(value) for key, value in trial.params.items()},
            run=trial.user_attrs.get("run", ""),
            value=trial.value,
        )
        for trial in study.trials
    ]
    objective = study.user_attrs.get("objective", "held_out/nll")
    record = Search(name=folder.name, objective=objective, trials=trials, importances=importances)
    write_atomic(folder / RECORD, record.model_dump_json(indent=2) + "\n")
    return record
