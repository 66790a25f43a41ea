"""What distinguishes runs: their choices, and every other key that changes the law of their results."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PLAIN_RECIPE = "paper"
"""The recipe that a run's folder does not name."""


def setting(preset: str, recipe: str) -> str:
    """Preset and recipe in one word, no part of which holds a plus sign."""
    return preset if recipe == PLAIN_RECIPE else f"{preset}+{recipe}"


def preset_and_recipe(setting: str) -> tuple[str, str]:
    """The two that make a `setting`."""
    preset, _, recipe = setting.partition("+")
    return preset, recipe or PLAIN_RECIPE


def in_words(setting: str) -> str:
    """A `setting` as a heading says it."""
    preset, recipe = preset_and_recipe(setting)
    return f"preset {preset}" if recipe == PLAIN_RECIPE else f"preset {preset}, recipe {recipe}"


WITHOUT_INFLUENCE = (
    "runs",
    "logger",
    "data.root",
    "data.workers",
    "trainer.accelerator",
    "trainer.progress_bar",
    "trainer.threads",
    "evaluation.calibration_every_n_epochs",
    "evaluation.every_n_epochs",
    "evaluation.multiview",
)
"""Keys, or sections, of how a run is computed, recorded and measured: they do not change the law of its results."""


@dataclass(frozen=True)
class RunName:
    """The choices that name a run, and the folder they give; `preset` with the recipe, as `setting` joins them."""

    preset: str
    data: str
    model: str
    seed: int
    overrides: tuple[str, ...] = ()

    def folder(self, runs: Path) -> Path:
        """The run's folder under `runs`; overrides beyond the choices become a hash of eight digits."""
        leaf = f"seed{self.seed}"
        if self.overrides:
            digest = hashlib.sha256("\n".join(sorted(self.overrides)).encode()).hexdigest()
            leaf += f"-{digest[:8]}"
        return runs / self.preset / self.data / self.model / leaf


def has_influence(key: str) -> bool:
    """Whether a dotted key changes the law of a run's results, and not only how they are computed."""
    return not any(key == name or key.startswith(f"{name}.") for name in WITHOUT_INFLUENCE)


def flatten(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one mapping with dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        path = f"{prefix}{key}"
        flat |= flatten(value, f"{path}.") if isinstance(value, dict) else {path: value}
    return flat
