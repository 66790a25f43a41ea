"""The coordinates that the file of a mesh lists; Blender's importers read those that are no finite numbers as 0."""

import base64
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from phd_exp.records.mesh_files import split_gltf

Points = NDArray[Any]
_TYPES = {"char": "i1", "uchar": "u1", "int": "i4", "uint": "u4", "float": "f4"}  # of PLY, where NumPy's differ


def require_finite(points: Points) -> None:
    """Raise ValueError unless coordinates (n, 3) are finite 32-bit numbers."""
    with np.errstate(over="ignore"):
        wrong = np.flatnonzero(~np.isfinite(points.astype(np.float32)).all(axis=1))
    if len(wrong):
        raise ValueError(f"vertex {wrong[0] + 1} is at {points[wrong[0]].tolist()}; expected finite coordinates")


def require_finite_file(suffix: str, content: bytes) -> None:
    """Raise ValueError unless a mesh's file lists finite coordinates alone, as far as they are not compressed."""
    try:
        for points in _READERS[suffix](content):
            require_finite(points)
    except (AttributeError, LookupError, TypeError) as error:  # of a stranger's structure
        raise ValueError(f"cannot be read as {suffix} ({error})") from None


def _of_lines(word: bytes) -> Callable[[bytes], Iterator[Points]]:
    def read(content: bytes) -> Iterator[Points]:
        lines = re.findall(rb"(?m)^[ \t]*%b[ \t][^\n]*" % word, content.replace(b"\\\n", b""))
        yield np.loadtxt(lines, usecols=(1, 2, 3), ndmin=2) if lines else np.empty((0, 3))

    return read


def _of_stl(content: bytes) -> Iterator[Points]:
    n = int.from_bytes(content[80:84], "little")
    if len(content) == 84 + 50 * n:
        return iter([np.ndarray((n, 9), "<f4", content, 96, (50, 4)).reshape(-1, 3)])
    return _of_lines(b"vertex")(content)


def _of_ply(content: bytes) -> Iterator[Points]:
    """None if the first element has lists, or is not the vertices."""
    head, _, body = content.partition(b"end_header")
    element, body = re.split(rb"(?m)^element ", head)[1], body[body.find(b"\n") + 1 :]
    if element.startswith(b"vertex ") and b" list " not in element:
        n, fields = int(element.split()[1]), re.findall(r"property +(\w+) +(\w+)", element.decode())
        names = [name for _, name in fields]
        if b"format ascii" in head:
            yield np.loadtxt(body.split(b"\n", n)[:n], usecols=[names.index(axis) for axis in "xyz"], ndmin=2)
        else:
            order = ">" if b"big_endian" in head else "<"
            types = [(name, order + np.dtype(_TYPES.get(kind, kind)).str[1:]) for kind, name in fields]
            rows = np.frombuffer(body, types, n)
            yield np.stack([rows[axis] for axis in "xyz"], axis=1)


def _of_gltf(content: bytes) -> Iterator[Points]:
    document, binary = split_gltf(content)
    buffers = [_buffer(item.get("uri"), binary[8:]) for item in document.get("buffers", ())]
    parts = [part["attributes"] for mesh in document.get("meshes", ()) for part in mesh["primitives"]]
    for number in {part["POSITION"] for part in parts if "POSITION" in part}:
        accessor = document["accessors"][number]
        if accessor["componentType"] == 5126 and "bufferView" in accessor:  # neither whole numbers nor compressed
            view = document["bufferViews"][accessor["bufferView"]]
            start, strides = (
                view.get("byteOffset", 0) + accessor.get("byteOffset", 0),
                (view.get("byteStride", 12), 4),
            )
            yield np.ndarray((accessor["count"], 3), "<f4", buffers[view["buffer"]], start, strides)


def _buffer(uri: str | None, binary: bytes) -> bytes:
    if uri is None:
        return binary
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    return Path(unquote(uri)).read_bytes()


_READERS = {".glb": _of_gltf, ".gltf": _of_gltf, ".obj": _of_lines(b"v"), ".ply": _of_ply, ".stl": _of_stl}
