"""The user's files that a data set is made from: meshes with their textures, and backdrops."""

import errno
import os
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from phd_exp.records.errors import listed
from phd_exp.records.files import MB, checksum, require_plain
from phd_exp.records.mesh_files import read_mesh
from phd_exp.records.parsing import Record

LARGEST_MESH = 128 * MB  # bytes of a file, which has about a million faces as text
MESHES = (".glb", ".gltf", ".obj", ".ply", ".stl")
SKIES = (".exr", ".hdr")
PHOTOS = (".png", ".jpg", ".jpeg", ".webp")
HDRI = "hdri"
BLENDERS_SKIES = ("night", "city", "interior", "forest", "studio", "sunset", "sunrise", "courtyard")
"""The skies inside Blender's package, in the order in which they are split."""
FEWEST_BACKDROPS = 4  # every fourth is for test samples alone


class Asset(Record):
    """Files that are identified by their contents.

    Attributes:
        files: SHA-256 of each file by its name; of a mesh, the mesh first, then the neighbours that it names.
        folder: where the files are on this machine; None if the asset was read from a record.
    """

    files: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]]
    folder: Path | None = Field(default=None, exclude=True, repr=False)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Asset) and self.files == other.files

    def __str__(self) -> str:
        return listed([f"{name} (SHA-256 {digest[:8]}...)" for name, digest in self.files.items()])

    def path(self, name: str) -> Path:
        """The path of a file. Raises ValueError if the folder is not known."""
        if self.folder is None:
            raise ValueError(f"no record says where {name} is; name its place on the command line")
        return self.folder / name


def mesh_asset(given: Any) -> Any:
    """A mesh that the user names by its path; others are returned unchanged. Raises ValueError if it is none."""
    if not isinstance(given, (str, Path)):
        return given
    path = Path(given)
    if path.suffix.lower() not in MESHES:
        raise ValueError(f"expected a file of a mesh: {', '.join(MESHES)}")
    try:
        require_plain(path, LARGEST_MESH)
        return _asset(path.parent, [path, *read_mesh(path).files])
    except OSError as error:
        remedy = "simplify it" if error.errno == errno.EFBIG else "give another file"
        raise ValueError(f"cannot be used ({error.strerror}); {remedy}") from None


def backdrops_asset(given: Any) -> Any:
    """The backdrops in a folder that the user names; anything else is returned unchanged. Raises ValueError."""
    if not isinstance(given, (str, Path)) or given == HDRI:
        return given
    kinds = (*PHOTOS, *SKIES)
    files = sorted(path for path in Path(given).glob("*") if path.suffix.lower() in kinds)
    if len(files) < FEWEST_BACKDROPS:
        raise ValueError(
            f"expected a folder with at least {FEWEST_BACKDROPS} images ({', '.join(kinds)}), found {len(files)}; or "
            f"{HDRI} for Blender's own skies"
        )
    return _asset(Path(given), files)


def _asset(folder: Path, files: list[Path]) -> Asset:
    sums = {os.path.relpath(file, folder): _checksum(file.absolute(), file.stat().st_mtime_ns) for file in files}
    return Asset(files=sums, folder=folder.absolute())


@cache  # a configuration is checked more than once
def _checksum(path: Path, changed_ns: int) -> str:
    return checksum(path)
