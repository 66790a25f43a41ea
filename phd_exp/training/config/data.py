"""The section `data`: a rendered set or the user's own images, and how much of it a run uses."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag, model_validator

from phd_exp.records.spec import DatasetSpec
from phd_exp.training.config.section import Folder, Name, Section, Whole

SMALLEST_IMAGE = 32
"""A ResNet halves the side five times."""
LARGEST_IMAGE = 4096
"""As the largest that are rendered."""


class SizesConfig(Section):
    """How much of a data set a run uses, whatever its kind; None: all there is."""

    n_train: Annotated[Whole, Field(ge=1)] | None
    n_held_out: Annotated[Whole, Field(ge=0)]
    n_test: Annotated[Whole, Field(ge=1)] | None
    image_size: Annotated[Whole, Field(ge=SMALLEST_IMAGE, le=LARGEST_IMAGE)]
    batch_size: Annotated[Whole, Field(ge=1)]


class RenderedConfig(SizesConfig):
    """A rendered data set (the keys of `DatasetSpec`) and how much of it a run uses."""

    root: Folder
    n_train: Annotated[Whole, Field(ge=1)]
    n_test: Annotated[Whole, Field(ge=1)]
    workers: Annotated[Whole, Field(ge=1)] | None
    spec: DatasetSpec

    @model_validator(mode="before")
    @classmethod
    def gather_spec(cls, values: Any) -> Any:
        """The user writes the keys of the specification beside the others, without a level of their own."""
        if not isinstance(values, dict) or "spec" in values:
            return values
        spec = {key: value for key, value in values.items() if key in DatasetSpec.model_fields}
        return {key: value for key, value in values.items() if key not in spec} | {"spec": spec}

    @property
    def n_training_split(self) -> int:
        """Samples to render of the training split."""
        return self.n_train + self.n_held_out

    @property
    def name(self) -> str:
        """What its runs are named by: the variant."""
        return self.spec.variant

    @property
    def folder(self) -> Path:
        """Where the data set lies."""
        return self.root / self.spec.variant


class FolderConfig(SizesConfig):
    """A folder of the user's own images; `name` names its runs."""

    name: Name
    folder: Folder


def is_folder(values: Any) -> bool:
    """Whether a `data` section is the user's own: a rendered set is specified, by more than one key."""
    if not isinstance(values, dict):
        return isinstance(values, FolderConfig)
    return "spec" not in values and len(DatasetSpec.model_fields.keys() & values.keys()) <= 1


DataConfig = Annotated[
    Annotated[RenderedConfig, Tag("<rendered>")] | Annotated[FolderConfig, Tag("<folder>")],
    Discriminator(lambda values: "<folder>" if is_folder(values) else "<rendered>"),
]
