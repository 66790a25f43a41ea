"""What distinguishes runs: their choices, and all other keys that change the distribution of their results."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PLAIN_RECIPE = "paper"  # the recipe that a run's folder does not name


def setting(preset: str, recipe: str) -> str:
    """Preset and recipe in one word; neither contains a plus sign."""
    return preset if recipe == PLAIN_RECIPE else f"{preset}+{recipe}"


def preset_and_recipe(setting: str) -> tuple[str, str]:
    """Preset and recipe of a `setting`."""
    preset, _, recipe = setting.partition("+")
    return preset, recipe or PLAIN_RECIPE


def in_words(setting: str) -> str:
    """A `setting` as part of a heading."""
    preset, recipe = preset_and_recipe(setting)
    return f"preset {preset}" if recipe == PLAIN_RECIPE else f"preset {preset}, recipe {recipe}"


WITHOUT_INFLUENCE = (
    "runs",
    "logger",
    "data.root",
    "data.workers",
    "trainer.accelerator",
    "trainer.profiler",
    "trainer.progress_bar",
    "trainer.threads",
    "evaluation.calibration_every_n_epochs",
    "evaluation.eight_views",
    "evaluation.every_n_epochs",
    "evaluation.held_out",
    "evaluation.multiview",
    "evaluation.sequence_cameras",
    "evaluation.sequences",
    "evaluation.shifts",
    "evaluation.n_shifted",
)
"""Keys or sections that define how a run is computed, recorded and measured, but not its results' distribution."""


@dataclass(frozen=True)
class RunName:
    """The choices that name a run and its folder; `preset` is a `setting`, which may include the recipe.

    Examples:
        >>> RunName("paper", "scale", "mae_logz", seed=3).folder(Path("runs")).as_posix()
        'runs/paper/scale/mae_logz/seed3'
    """

    preset: str
    data: str
    model: str
    seed: int
    overrides: tuple[str, ...] = ()

    def folder(self, runs: Path) -> Path:
        """The run's folder under `runs`; other overrides become a hash of eight digits."""
        leaf = f"seed{self.seed}"
        if self.overrides:
            digest = hashlib.sha256("\n".join(sorted(self.overrides)).encode()).hexdigest()
            leaf += f"-{digest[:8]}"
        return runs / self.preset / self.data / self.model / leaf


def has_influence(key: str) -> bool:
    """Whether a dotted key changes the distribution of a run's results, not only their computation."""
    return not any(key == name or key.startswith(f"{name}.") for name in WITHOUT_INFLUENCE)


def first_difference(
    before: Mapping[str, Any], now: Mapping[str, Any], matters: Callable[[str], bool] = has_influence
) -> str | None:
    """The first dotted key that matters with two values, "KEY=VALUE, but KEY=VALUE"; None if there is none."""
    recorded, asked = flatten(dict(before)), flatten(dict(now))
    for key in sorted(filter(matters, recorded.keys() | asked.keys())):
        old, new = recorded.get(key, "nothing"), asked.get(key, "nothing")
        if old != new:
            return f"{key}={old}, but {key}={new}"
    return None


def flatten(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one mapping with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        path = f"{prefix}{key}"
        flat |= flatten(value, f"{path}.") if isinstance(value, dict) else {path: value}
    return flat
