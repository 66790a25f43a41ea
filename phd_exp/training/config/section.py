"""What every section of a configuration is made of: keys of its own, whole numbers, names and folders."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

Whole = Annotated[int, Field(strict=True)]
Name = Annotated[str, Field(strict=True, pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]


def _named(folder: Any) -> Any:
    """Refuse an empty text, which would be the current folder, and what is no name at all."""
    if not folder or not isinstance(folder, (str, Path)):
        raise ValueError("expected the name of a folder")
    return folder


Folder = Annotated[Path, Field(strict=False), BeforeValidator(_named)]


class Section(BaseModel):
    """A part of the configuration: no key but its own, and none of them changes."""

    model_config = ConfigDict(extra="forbid", frozen=True)
