"""What a configuration must look like: checked as a whole before anything is built.

The YAML files under conf/ hold the values, these their types and ranges; neither repeats the other. A group whose
choices are closed (data, trainer, ...) is a model here. A group that is open to new classes (backbone, head, loss,
optimizer) names a `_target_`, and its keys are held against that target's own signature (`targets.py`).
"""

from phd_exp.training.config.check import check, check_render
from phd_exp.training.config.data import FolderConfig, RenderedConfig
from phd_exp.training.config.run import RenderConfig, RunConfig
from phd_exp.training.config.sections import TrainerConfig

__all__ = [
    "FolderConfig",
    "RenderConfig",
    "RenderedConfig",
    "RunConfig",
    "TrainerConfig",
    "check",
    "check_render",
]
