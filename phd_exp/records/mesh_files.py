"""What the file of a mesh names, and a copy of it for Blender, without what moves or is hidden."""

import os
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
from numpy.typing import NDArray

from phd_exp.records.gltf import joined_gltf, keep_default_scene_at_rest, split_gltf

MATERIALS = "materials.mtl"  # which the copy of an OBJ names
_BOM = b"\xef\xbb\xbf"
_OBJ_LINE = re.compile(rb"\n[ \t]*(mtllib|usemtl)\b[ \t]*(.*?)[ \t\r]*(?=\n)")  # faster than ^ and $
_OBJ_COLOUR = re.compile(rb"\n[ \t]*v(?:[ \t]+[^\s#]+){6}")  # after x, y, z
_NEW_MATERIAL = re.compile(rb"^[ \t]*newmtl[ \t]+(.*?)[ \t\r]*$", re.M)
_OPTION = rb"-(?:type|colorspace)[ \t]+\w+[ \t]+|"
_OPTION += rb"-\w+(?:[ \t]+(?:on|off|[rgbmlz]|[-+]?[\d.]+(?:e[-+]?\d+)?)(?=[ \t]))*[ \t]+"
_MAP = re.compile(
    rb"^([ \t]*(?:map_(?!aat)\w+|bump|disp|decal|refl|norm)[ \t]+(?:%b)*)(.+?)[ \t\r]*$" % _OPTION, re.M | re.I
)
_UNIT = re.compile(rb"^[ \t]*#(?=[^\n]*\bunits?\b)[^\n]*?\b(milli|centi|inch|mm\b|cm\b|met(?:er|re))", re.M | re.I)
_UNITS = {b"milli": 0.001, b"mm": 0.001, b"centi": 0.01, b"cm": 0.01, b"inch": 0.0254, b"meter": 1.0, b"metre": 1.0}
_PLY_NAMES = {b"r": b"red", b"g": b"green", b"b": b"blue", b"a": b"alpha", b"u": b"s", b"v": b"t"}
_PLY_NAMES |= {b"texture_u": b"s", b"texture_v": b"t"}
_PLY_NAMES |= {b"diffuse_" + name: name for name in (b"red", b"green", b"blue", b"alpha")}
"""Names that Blender knows of properties of vertices."""
_PLY_TYPES = {b"char": "i1", b"uchar": "u1", b"int": "i4", b"uint": "u4", b"float": "f4"}  # unlike NumPy's


@dataclass
class MeshFile:
    """The file of a mesh, with what it names.

    Attributes:
        path: where it is.
        copy: its content for Blender; the names of other files are absolute.
        materials: of an OBJ: the content of its MTL files.
        texture: of a PLY.
        files: the files that it names.
        lost: why parts of its look cannot be drawn.
        has_colours: whether a vertex of an OBJ has a colour.
        coordinates: returns those of its vertices (n, 3); none for glTF, whose bounds Blender checks.
    """

    path: Path
    copy: bytes
    materials: bytes = b""
    texture: Path | None = None
    files: list[Path] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    has_colours: Callable[[], bool] = bool
    coordinates: Callable[[], NDArray[Any]] = lambda: np.empty((0, 3))

    def find(self, name: str, folder: Path) -> Path | None:
        """The file that a text in `folder` names, perhaps with Windows' separators or a place on another machine."""
        plain = unquote(name.strip("\"'")).replace("\\", "/")
        for candidate in (name, plain, PurePosixPath(plain).name):
            if candidate and os.path.isfile(path := folder / candidate):
                self.files += [path] if path not in self.files else []
                return path.absolute()
        self.lost.append(f"{name} is missing")
        return None

    @property
    def stated_unit(self) -> float | None:
        """The unit that a comment of an OBJ states, m; that of glTF by its standard; None for other files."""
        if self.path.suffix.lower() != ".obj":
            return 1.0 if self.path.suffix.lower() in (".glb", ".gltf") else None
        found = _UNIT.search(self.copy)
        return _UNITS[found[1].lower()] if found else None

    def require_finite(self) -> None:
        """Raise ValueError unless all coordinates are finite 32-bit numbers; Blender reads others as 0."""
        points = _of_stranger(self.coordinates, self.path)
        with np.errstate(over="ignore"):
            wrong = np.flatnonzero(~np.isfinite(points.astype(np.float32)).all(axis=1))
        if len(wrong):
            raise ValueError(f"vertex {wrong[0] + 1} is at {points[wrong[0]].tolist()}; expected finite coordinates")


def read_mesh(path: Path) -> MeshFile:
    """Read the file of a mesh, and the MTL files of an OBJ.

    Raises:
        ValueError: it is invalid, or a part of its geometry is missing.
        OSError: a file cannot be read.
    """
    mesh = MeshFile(path, path.read_bytes())
    readers = {".glb": _read_gltf, ".gltf": _read_gltf, ".obj": _read_obj, ".ply": _read_ply, ".stl": _read_stl}
    _of_stranger(lambda: readers[path.suffix.lower()](mesh), path)
    return mesh


def _of_stranger(read: Callable[[], Any], path: Path) -> Any:
    """What a function returns; raises ValueError if the structure of a stranger's file is another than it expects."""
    try:
        return read()
    except (AttributeError, LookupError, TypeError, ValueError, struct.error) as error:
        raise ValueError(f"cannot be read as {path.suffix} ({error})") from None


def _read_gltf(mesh: MeshFile) -> None:
    document, rest = split_gltf(mesh.copy)
    if (version := document.get("asset", {}).get("version")) != "2.0":
        raise ValueError(f"glTF of version {version}; expected 2.0")
    for key in ("buffers", "images"):
        for item in document.get(key, ()):
            uri = item.get("uri", "data:")
            if not uri.startswith("data:") and (path := mesh.find(unquote(uri), mesh.path.parent)):
                item["uri"] = quote(str(path))
        if key == "buffers" and mesh.lost:
            raise ValueError(f"{mesh.lost[0]}; put it where the file names it")
    for texture in document.get("textures", ()):
        if "source" not in texture and "EXT_texture_webp" not in (kinds := texture.get("extensions", {})):
            mesh.lost.append(f"a texture has no image of a known kind ({', '.join(kinds)})")
    keep_default_scene_at_rest(document)
    mesh.copy = joined_gltf(document, rest, is_binary=mesh.copy.startswith(b"glTF"))


def _read_obj(mesh: MeshFile) -> None:
    text = b"\n%b\n" % mesh.copy.removeprefix(_BOM).replace(b"\\\n", b"").replace(b"\\\r\n", b"")
    if b"\0" in text:
        raise ValueError("has bytes that are no text; expected UTF-8")
    lines = _OBJ_LINE.findall(text)
    used = {name for word, name in lines if word == b"usemtl"}
    named = [os.fsdecode(name) for word, name in lines if word == b"mtllib"]
    if used and not named and mesh.path.with_suffix(".mtl").is_file():  # which Blender reads
        named = [f"{mesh.path.stem}.mtl"]
    for name in named:
        for part in re.findall(r"\S.*?\.mtl(?=\s|$)|\S.*", name, re.I):  # several on one line
            mesh.materials += _read_mtl(mesh, mesh.find(part, mesh.path.parent))
    known = set(_NEW_MATERIAL.findall(mesh.materials))
    if not mesh.lost:
        mesh.lost += [f"no material is named {os.fsdecode(name)!r}" for name in sorted(used - known)]
    if not used and len(known) > 1:
        mesh.lost.append(f"no usemtl says which of {len(known)} materials it has")
    only = b"usemtl %b\n" % known.pop() if not used and len(known) == 1 else b""
    mesh.copy = b"mtllib %b\n" % MATERIALS.encode() + only + re.sub(rb"\n[ \t]*mtllib\b[^\n]*", b"", text)
    mesh.has_colours = lambda: bool(_OBJ_COLOUR.search(text))
    mesh.coordinates = lambda: _numbers(rb"v", text)


def _read_mtl(mesh: MeshFile, path: Path | None) -> bytes:
    """The content of an MTL file with absolute names of textures; nothing if there is no file."""

    def absolute(match: re.Match[bytes]) -> bytes:
        found = mesh.find(os.fsdecode(match[2]), path.parent) if path else None
        return match[1] + os.fsencode(found) if found else match[0]

    return _MAP.sub(absolute, path.read_bytes().removeprefix(_BOM)) + b"\n" if path else b""


def _read_ply(mesh: MeshFile) -> None:
    head, end, body = mesh.copy.partition(b"end_header")
    sections = {part.split()[1]: part for part in re.split(rb"(?m)^(?=element\b)", head)[1:]}
    vertex = re.sub(rb"(?m)\w+(?=\s*$)", lambda name: _PLY_NAMES.get(name[0], name[0]), sections.get(b"vertex", b""))
    mesh.copy = head.replace(sections.get(b"vertex", b""), vertex) + end + body
    kinds = {name: kind for *_, kind, name in map(bytes.split, re.findall(rb"property[^\r\n]+", vertex))}
    for name in map(os.fsdecode, re.findall(rb"(?im)^comment[ \t]+TextureFile[ \t]+(.*?)\s*$", head)):
        mesh.texture = mesh.find(name, mesh.path.parent)
        if b"t" not in kinds:
            mesh.lost.append(f"vertices have no texture coordinates (s, t) for {name}")
    if b" red" in sections.get(b"face", b"") and not {b"red", b"t"} & kinds.keys():
        mesh.lost.append("colours of faces are not read; expected colours of vertices")
    if kinds.get(b"red", b"uchar") not in (b"uchar", b"uint8", b"float", b"float32", b"double", b"float64"):
        mesh.lost.append(f"colours of vertices are of type {kinds[b'red'].decode()}; expected uchar")
    if list(sections)[:1] == [b"vertex"] and b" list " not in vertex:
        mesh.coordinates = lambda: _rows(head, kinds, int(vertex.split()[2]), body[body.find(b"\n") + 1 :])


def _rows(head: bytes, kinds: dict[bytes, bytes], n: int, body: bytes) -> NDArray[Any]:
    """Coordinates (n, 3) of the vertices of a PLY."""
    if b"format ascii" in head:
        columns = [list(kinds).index(axis) for axis in (b"x", b"y", b"z")]
        return np.loadtxt(body.split(b"\n", n)[:n], usecols=columns, ndmin=2)
    order: Any = ">" if b"big_endian" in head else "<"
    types = [np.dtype(_PLY_TYPES.get(kind, kind.decode())).newbyteorder(order) for kind in kinds.values()]
    rows = np.frombuffer(body, list(zip(map(bytes.decode, kinds), types, strict=True)), n)
    return np.stack([rows[axis] for axis in "xyz"], axis=1)


def _read_stl(mesh: MeshFile) -> None:
    if b"COLOR=" in mesh.copy[:80]:
        mesh.lost.append("colours of faces (COLOR=) are not read")
    n = int.from_bytes(mesh.copy[80:84], "little")
    if n and len(mesh.copy) == 84 + 50 * n:
        mesh.coordinates = lambda: np.ndarray((n, 9), "<f4", mesh.copy, 96, (50, 4)).reshape(-1, 3)
    else:
        mesh.coordinates = lambda: _numbers(rb"vertex", mesh.copy)


def _numbers(word: bytes, text: bytes) -> NDArray[Any]:
    """The three numbers (n, 3) after each `word` that begins a line."""
    lines = re.findall(rb"(?m)^[ \t]*%b[ \t][^\n]*" % word, text)
    return np.loadtxt(lines, usecols=(1, 2, 3), ndmin=2) if lines else np.empty((0, 3))
