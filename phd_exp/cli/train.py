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
from phd_exp.records.dataset import DatasetFolder
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
SCORES = ("test/nll", "test/depth_error_mm")
"""The number that a sweeper takes: of a baseline, which has no likelihood, the depth error."""


def main(words: list[str]) -> int:
    """Train once or for every combination; returns the exit status."""
    return launch(task, words, standing=standing)


def task(config: dict[str, Any], overrides: list[str], cores: int) -> float | None:
    """Render what is missing, train and print the numbers of one run; returns the first of SCORES that it has."""
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
        announce(checked, folder, overrides)
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
    return next((results[key] for key in SCORES if results.get(key) is not None), None)


def announce(checked: RunConfig, folder: RunFolder, overrides: list[str]) -> None:
    """Say what the run is going to do and, where that takes long, what would not."""
    from phd_exp.training.network import has_gpu

    data, epochs = checked.data, checked.trainer.max_epochs
    network = f"{checked.backbone['_target_'].rpartition('.')[2]}{checked.backbone.get('depth', '')}"
    device = "a GPU" if has_gpu(checked.trainer) else "the CPU"
    images = "all" if data.n_train is None else data.n_train
    print(f"{folder.path}: {_to_render(checked)}{epochs} epochs of {network} on {images} images of", end=" ")
    print(f"{data.image_size} px, on {device}", flush=True)
    if checked.preset == "paper" and not has_gpu(checked.trainer):
        words = " ".join([*(word for word in overrides if not word.startswith("preset=")), "preset=small"])
        print("  the authors' protocol takes many hours without a GPU: an estimate follows the first batches")
        print(f"  in about ten minutes: python -m phd_exp {words}", flush=True)


def _to_render(checked: RunConfig) -> str:
    data = checked.data
    if not isinstance(data, RenderedConfig):
        return ""
    missing = DatasetFolder(data.folder).missing(data.spec, data.n_training_split, data.n_test)
    n = sum(map(len, missing.values()))
    return f"{n} images to render, then " if n else ""


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, int | float) else "not finite"


def standing(config: dict[str, Any], overrides: list[str]) -> str | None:
    """How the run of a configuration stands; the configuration is not checked yet, since checking imports torch."""
    try:
        data = config["data"].get("variant") or config["data"]["name"]
        preset = setting(config["preset"], config["recipe"]["name"])
        name = RunName(preset, data, config["model"]["name"], config["seed"], _telling(overrides))
        folder = RunFolder(name.folder(Path(config["runs"])))
        status = folder.status()
        if status is None:
            return None
        if status.state == "running":
            return "running" if folder.is_held() else "exited without a result (killed or out of memory)"
        several = config["evaluation"]["multiview"]["scenes"] > 0
        is_whole = status.state == "finished" and (folder.views.exists() or not several)
        return "finished" if is_whole else status.error or "interrupted"
    except (KeyError, TypeError, AttributeError, OSError, RunError):  # the run itself will say what is wrong
        return None


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
