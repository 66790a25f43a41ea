"""`python -m phd_exp [train]`: render what is missing, train, measure and record a run."""

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from phd_exp.cli.app import launch
from phd_exp.cli.render import ensure_dataset
from phd_exp.cli.several_views import Several
from phd_exp.records.choices import RunName, has_influence, setting
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder
from phd_exp.training.config import RenderedConfig, RunConfig, check

NAMED = ("preset", "recipe", "data", "data.name", "model", "seed", "experiment")
"""Choices that have a place of their own in a run's name, and the one that does nothing but name several runs."""
SHOWN = (
    "test/projected_error_mm",
    "test/depth_error_mm",
    "test/nll",
    "test/calibration/depth_ence",
    "test/calibration/projected_ence",
    "test/calibration/miscalibration_area",
)
"""What is printed at the end of a run; results.json holds more."""


def main(arguments: list[str]) -> int:
    """Train as the words say, once or for every combination; returns the exit status."""
    return launch(task, arguments, is_finished=is_finished)


def task(config: dict[str, Any], overrides: list[str], cores: int) -> str:
    """What one job of training does: render what is missing, train, print the numbers; returns its state."""
    checked = check(config)
    # seconds of imports, which a refused configuration need not wait for
    from phd_exp.training.run import require_possible, train

    folder = RunFolder(run_name(checked, overrides).folder(checked.runs))
    several = Several.of(checked)
    skipped = folder.is_finished()
    if not skipped:
        require_possible(checked, folder)
        if several:
            several.require_possible()
        if isinstance(checked.data, RenderedConfig):
            ensure_dataset(checked.data, cores)
    results = train(checked, folder, draw=_draw(), cores=cores)
    if several:
        several.record(folder, cores)
    state = "finished already" if skipped else "finished"
    print(f"{folder.path}: {state}")
    for key in filter(results.__contains__, SHOWN):
        print(f"  {key} {_number(results[key])} (untrained {_number(results.get(f'untrained/{key}'))})")
    if (folder.calibration / "final.png").exists():
        print(f"  calibration curves: {folder.calibration / 'final.png'}")
    return state


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else "not finite"


def is_finished(config: dict[str, Any], overrides: list[str]) -> bool:
    """Whether the run of a configuration is there; one that is not checked yet, since checking imports torch."""
    try:
        data = config["data"].get("variant") or config["data"]["name"]
        choices = (
            setting(config["preset"], config["recipe"]["name"]),
            data,
            config["model"]["name"],
            config["seed"],
        )
        folder = RunFolder(RunName(*choices, _telling(overrides)).folder(Path(config["runs"])))
        several = config["evaluation"]["multiview"]["scenes"] > 0
        return folder.is_finished() and (folder.views.exists() or not several)
    except (KeyError, TypeError, AttributeError, RunError):  # the run itself will say what is wrong
        return False


def run_name(config: RunConfig, overrides: list[str]) -> RunName:
    """The choices that name a run; every other override that can change a number goes into its hash."""
    return RunName(config.setting, config.data.name, config.model.name, config.seed, _telling(overrides))


def _telling(overrides: list[str]) -> tuple[str, ...]:
    parsed = OverridesParser.create().parse_overrides(overrides)
    # 1e-3 and 0.001, true and True are one value: a sweep hands on the one where the user wrote the other
    texts = [f"{item.key_or_group}={item.get_value_element_as_str()}" for item in parsed]
    return tuple(text for text in texts if _is_telling(text))


def _is_telling(override: str) -> bool:
    key = override.split("=")[0]
    return key not in NAMED and has_influence(key)


def _draw() -> Callable[[dict[str, Any], Path], None] | None:
    if find_spec("matplotlib") is None:
        print("calibration curves are recorded, but not drawn: that needs `pip install 'phd_exp[report]'`")
        return None
    from phd_exp.reports.figures import draw_calibration

    return draw_calibration
