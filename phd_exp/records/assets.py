"""The user's files that a data set is made from: meshes with their textures, and backdrops.

A mesh's number of faces and the files that it names are read from its headers, so that too large a mesh is refused
before memory runs out. Blender reads the rest.
"""

import hashlib
import mmap
import re
import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import unquote

from pydantic import Field

from phd_exp.records.errors import gist, listed, one_line
from phd_exp.records.files import MB, require_plain
from phd_exp.records.parsing import Record, parse_json

MOST_FACES = 1_000_000
LARGEST_HEADER = 16 * MB
MESHES = (".glb", ".gltf", ".obj", ".ply", ".stl")
SKIES = (".exr", ".hdr")
PHOTOS = (".png", ".jpg", ".jpeg", ".webp")
HDRI = "hdri"
BLENDERS_SKIES = ("night", "city", "interior", "forest", "studio", "sunset", "sunrise", "courtyard")
"""The skies inside Blender's package, in the order in which they are split."""
FEWEST_BACKDROPS = 4
_OPTIONS = rb"(?:-\w+(?:\s+(?:[-+.\d]+|on|off))*\s+)*"  # of a texture in an .mtl file


class Asset(Record):
    """Files that are identified by their contents.

    Attributes:
        files: SHA-256 of each file by its name; of a mesh, the mesh first, then the files that it names.
        folder: where the files are on this machine; None if the asset was read from a record.
    """

    files: dict[str, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]]
    folder: Path | None = Field(default=None, exclude=True, repr=False)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Asset) and self.files == other.files

    @property
    def name(self) -> str:
        """The first file: of a mesh, the mesh."""
        return next(iter(self.files))

    def path(self, name: str) -> Path:
        """The path of a file. Raises ValueError if this machine does not know the folder."""
        if self.folder is None:
            raise ValueError(f"the place of {name} is not recorded; give it again, by data.mesh or data.backdrops")
        return self.folder / name


def mesh_asset(given: Any) -> Any:
    """A mesh that the user names by its path, with the files that it names; anything else is returned unchanged.

    Raises ValueError if it is no mesh, has no faces or more than MOST_FACES, or lacks a file.
    """
    if not isinstance(given, (str, Path)):
        return given
    path = Path(given)
    if path.suffix.lower() not in MESHES:
        raise ValueError(f"expected a file of a mesh: {', '.join(MESHES)}")
    try:
        require_plain(path)
        faces, names = _described(path)
        missing = [name for name in names if not (path.parent / name).is_file()]
    except OSError as error:
        raise ValueError(f"cannot be read ({error.strerror}); expected a file of a mesh") from None
    except (ValueError, LookupError, TypeError, AttributeError, struct.error) as error:
        raise ValueError(f"is no {path.suffix} mesh ({one_line(gist(error))}); export it again") from None
    if not 0 < faces <= MOST_FACES:
        raise ValueError(f"has {faces} faces; expected 1 to {MOST_FACES}; Blender's modifier Decimate removes some")
    if missing:
        raise ValueError(f"names {listed(missing)}, which is missing; put it into {path.parent.absolute()}")
    return _asset(path.parent, [path.name, *dict.fromkeys(names)])


def backdrops_asset(given: Any) -> Any:
    """The backdrops in a folder that the user names; anything else is returned unchanged. Raises ValueError."""
    if not isinstance(given, (str, Path)) or given == HDRI:
        return given
    folder = Path(given)
    kinds = (*PHOTOS, *SKIES)
    names = sorted(path.name for path in folder.glob("*") if path.suffix.lower() in kinds)
    if len(names) < FEWEST_BACKDROPS:
        raise ValueError(
            f"a folder with {len(names)} images ({', '.join(kinds)}); expected at least {FEWEST_BACKDROPS}, of which "
            f"every fourth is for test samples alone; or {HDRI}, Blender's own skies"
        )
    return _asset(folder, names)


def _asset(folder: Path, names: list[str]) -> Asset:
    paths = [(folder / name).absolute() for name in names]
    sums = [_checksum(path, path.stat().st_mtime_ns) for path in paths]
    return Asset(files=dict(zip(names, sums, strict=True)), folder=folder.absolute())


@cache  # a configuration is checked more than once
def _checksum(path: Path, changed_ns: int) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _described(path: Path) -> tuple[int, list[str]]:
    """The number of faces of a mesh, and the files that it names."""
    with open(path, "rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        match path.suffix.lower():
            case ".glb":
                magic, length = struct.unpack_from("<4s8xI", content)
                if magic != b"glTF" or length > LARGEST_HEADER:
                    raise ValueError("no binary glTF header")
                return _gltf(content[20 : 20 + length])
            case ".gltf":
                return _gltf(content[:LARGEST_HEADER])
            case ".obj":
                libraries = [_text(name) for name in re.findall(rb"(?m)^\s*mtllib\s+(.+?)\s*$", content)]
                return _count(rb"(?m)^\s*f\s", content), [*libraries, *_textures(path.parent, libraries)]
            case ".ply":
                header, end, _ = content[:65536].partition(b"end_header")
                if not header.startswith(b"ply") or not end:
                    raise ValueError("no header")
                found = re.search(rb"element face (\d+)", header)
                return int(found[1]) if found else 0, []
            case _:
                faces = struct.unpack_from("<I", content, 80)[0] if len(content) >= 84 else 0
                if len(content) != 84 + 50 * faces:
                    if content[:5] != b"solid":
                        raise ValueError("neither text nor as long as its header says")
                    faces = _count(rb"endfacet", content)
                return faces, []


def _gltf(content: bytes) -> tuple[int, list[str]]:
    document = parse_json(content.decode())
    counts = [
        sum(_corners(document, part) // 3 for part in mesh["primitives"]) for mesh in document.get("meshes", [])
    ]
    faces = sum(counts[node["mesh"]] for node in document.get("nodes", []) if "mesh" in node)
    parts = [part for kind in ("buffers", "images") for part in document.get(kind, [])]
    return faces, [unquote(part["uri"]) for part in parts if not part.get("uri", "data:").startswith("data:")]


def _corners(document: dict[str, Any], part: dict[str, Any]) -> int:
    accessor = part.get("indices", part["attributes"]["POSITION"])
    return int(document["accessors"][accessor]["count"]) if part.get("mode", 4) >= 4 else 0  # no points, no lines


def _textures(folder: Path, libraries: list[str]) -> Iterator[str]:
    for library in libraries:
        if (folder / library).is_file():
            with open(folder / library, "rb") as stream:
                lines = stream.read(LARGEST_HEADER)
            names = re.findall(rb"(?m)^\s*(?:map_\w+|bump|disp|decal|norm)\s+" + _OPTIONS + rb"(.+?)\s*$", lines)
            yield from map(_text, names)


def _text(name: bytes) -> str:
    return name.decode().replace("\\", "/")


def _count(pattern: bytes, content: mmap.mmap) -> int:
    return sum(1 for _ in re.finditer(pattern, content))
