"""Files of meshes in all formats that are read, written by hand from triangles."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from phd_exp.records.scenes import SceneObject, Shape
from phd_exp.rendering.meshes import build_mesh
from phd_exp.rendering.rays import rotation_matrix
from phd_exp.rendering.triangles import Triangles

Y_UP = (".glb", ".gltf", ".obj")


def solid(shape: Shape, size: float = 0.2, middle: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Triangles:
    """A solid as triangles, of a size in metres, around a point of its local frame."""
    mesh = build_mesh(shape)
    corners = [(face[0], face[k], face[k + 1]) for face in mesh.faces for k in range(1, len(face) - 1)]
    return Triangles(0.5 * size * np.array(mesh.vertices) + middle, np.array(corners, np.int32))


def placed(mesh: Triangles, item: SceneObject) -> np.ndarray:
    """The vertices of an object in its scene's frame, m, shape (n, 3)."""
    return item.scale * mesh.vertices @ rotation_matrix(item.rotation).T + np.array(item.position)


def write_mesh(path: Path, mesh: Triangles, per_metre: float = 1.0) -> Path:
    """Write a mesh in the format of the file's name; `per_metre` units are a metre."""
    x, y, z = per_metre * mesh.vertices.T
    points = np.stack([x, z, -y] if path.suffix in Y_UP else [x, y, z], axis=1).astype("<f4")
    {".obj": _obj, ".ply": _ply, ".stl": _stl, ".glb": _glb, ".gltf": _gltf}[path.suffix](path, points, mesh.corners)
    return path


def _obj(path: Path, points: np.ndarray, corners: np.ndarray) -> None:
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    path.write_text("\n".join([*lines, *(f"f {a} {b} {c}" for a, b, c in (corners + 1).tolist()), ""]))


def _ply(path: Path, points: np.ndarray, corners: np.ndarray) -> None:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    faces = f"element face {len(corners)}\nproperty list uchar int vertex_indices\n"
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{axes}{faces}end_header\n"
    rows = np.empty(len(corners), np.dtype([("n", "u1"), ("corners", "<i4", 3)]))
    rows["n"], rows["corners"] = 3, corners
    path.write_bytes(head.encode() + points.tobytes() + rows.tobytes())


def _stl(path: Path, points: np.ndarray, corners: np.ndarray) -> None:
    rows = np.zeros(len(corners), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")]))
    rows["corners"] = points[corners]
    path.write_bytes(bytes(80) + struct.pack("<I", len(corners)) + rows.tobytes())


def _glb(path: Path, points: np.ndarray, corners: np.ndarray) -> None:
    document, binary = _document(points, corners)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(binary)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, size) + chunks)


def _gltf(path: Path, points: np.ndarray, corners: np.ndarray) -> None:
    document, binary = _document(points, corners)
    document["buffers"][0]["uri"] = f"{path.stem}.bin"
    path.with_suffix(".bin").write_bytes(binary)
    path.write_text(json.dumps(document))


def _document(points: np.ndarray, corners: np.ndarray) -> tuple[dict, bytes]:
    binary = points.tobytes() + corners.astype("<u4").tobytes()
    bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    vertices = {"bufferView": 0, "componentType": 5126, "count": len(points), "type": "VEC3", **bounds}
    indices = {"bufferView": 1, "componentType": 5125, "count": corners.size, "type": "SCALAR"}
    views = [(0, points.nbytes), (points.nbytes, 4 * corners.size)]
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [vertices, indices],
        "bufferViews": [{"buffer": 0, "byteOffset": start, "byteLength": size} for start, size in views],
        "buffers": [{"byteLength": len(binary)}],
    }
    return document, binary


def ply_text(
    mesh: Triangles,
    of_vertices: Sequence[str] = (),
    vertex: str = "",
    of_faces: Sequence[str] = (),
    face: str = "",
    comment: str = "by hand",
) -> str:
    """A PLY as text, with further properties of vertices and faces, and their values."""
    head = ["ply", "format ascii 1.0", f"comment {comment}", f"element vertex {len(mesh.vertices)}"]
    head += [f"property {words}" for words in ("float x", "float y", "float z", *of_vertices)]
    head += [f"element face {len(mesh.corners)}", "property list uchar int vertex_indices"]
    head += [f"property {words}" for words in of_faces]
    rows = [f"{x!r} {y!r} {z!r} {vertex}".rstrip() for x, y, z in mesh.vertices.tolist()]
    rows += [f"3 {a} {b} {c} {face}".rstrip() for a, b, c in mesh.corners.tolist()]
    return "\n".join([*head, "end_header", *rows, ""])
