"""All that the file of a mesh names is found, or lost by name; its copy neither moves nor hides anything."""

import json
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from phd_exp.records.assets import mesh_asset
from phd_exp.records.gltf import joined_gltf, split_gltf
from phd_exp.records.mesh_files import read_mesh
from phd_exp.rendering.triangles import Triangles
from tests.support.meshes import ply_text, solid, write_mesh

CUBE = solid("cube")
GLTF = {"asset": {"version": "2.0"}}


def written(folder: Path, mesh: str, files: dict[str, str]) -> Path:
    """A mesh next to other files, each with its text."""
    for name, text in {mesh: files[mesh], **files}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(text.encode())
    return folder / mesh


def gltf_with(uri: str | None) -> str:
    """A glTF file with a texture, or with one of an unknown kind."""
    if uri is None:
        return json.dumps(GLTF | {"textures": [{"extensions": {"KHR_texture_basisu": {}}}]})
    return json.dumps(GLTF | {"images": [{"uri": uri}], "textures": [{"source": 0}]})


def ply_with(texture: str) -> str:
    return ply_text(CUBE, ("float s", "float t"), "0 0", comment=f"TextureFile {texture}")


NEAR, OTHER = "paint.png", "C:\\Users\\me\\wood floor.png"
TEXTURED = {
    "glTF with an escaped name": ("a.gltf", gltf_with("my%20paint.png"), {}, "my paint.png"),
    "glTF with a plain name": ("a.gltf", gltf_with("größe.png"), {}, "größe.png"),
    "glTF with an escaped unicode name": ("a.gltf", gltf_with("gr%C3%B6%C3%9Fe.png"), {}, "größe.png"),
    "glTF, two folders down": ("a.gltf", gltf_with("one/two/paint.png"), {}, "one/two/paint.png"),
    "glTF, beside its folder": ("in/a.gltf", gltf_with("../paint.png"), {}, NEAR),
    "OBJ, two folders down": ("a.obj", "mtllib b/a.mtl\n", {"b/a.mtl": "map_Kd c/paint.png"}, "b/c/paint.png"),
    "OBJ with Windows' names": ("a.obj", "mtllib .\\b\\a.mtl\r\n", {"b/a.mtl": "map_Kd t\\p.png\r\n"}, "b/t/p.png"),
    "OBJ of another machine": ("a.obj", "mtllib a.mtl\n", {"a.mtl": f"map_Kd {OTHER}"}, "wood floor.png"),
    "OBJ with two libraries": ("a.obj", "mtllib b.mtl c d.mtl\n", {"b.mtl": "", "c d.mtl": "bump -bm 5 1"}, "1"),
    "OBJ with options": ("a.obj", "mtllib a.mtl\n", {"a.mtl": "map_Ks -s 1 1 1 -colorspace sRGB a b.png"}, "a b.png"),
    "OBJ with the library of its name": ("a.obj", "usemtl x\n", {"a.mtl": "newmtl x\nmap_Kd paint.png"}, NEAR),
    "PLY": ("a.ply", ply_with("my paint.png"), {}, "my paint.png"),
}  # fmt: skip


@pytest.mark.parametrize("case", TEXTURED.values(), ids=TEXTURED)
def test_a_changed_texture_is_a_changed_mesh(tmp_path: Path, case: tuple[str, str, dict[str, str], str]) -> None:
    mesh, text, others, texture = case
    file = written(tmp_path, mesh, {mesh: text, **others, texture: "brown", "unrelated.png": ""})
    before = mesh_asset(file)
    assert os.path.relpath(tmp_path / texture, file.parent) in before.files
    assert {before.path(name).resolve() for name in before.files} == {
        (tmp_path / name).resolve() for name in (mesh, *others, texture)
    }
    assert read_mesh(file).lost == []
    (tmp_path / texture).write_text("black")
    assert mesh_asset(file) != before
    (tmp_path / texture).write_text("brown")
    assert mesh_asset(file) == before
    (tmp_path / texture).unlink()
    (lost,) = read_mesh(file).lost
    assert lost.endswith(" is missing")


def test_a_binary_gltf_may_name_files(tmp_path: Path) -> None:
    file = write_mesh(tmp_path / "part.glb", CUBE)
    document, rest = split_gltf(file.read_bytes())
    assert joined_gltf(document, rest, is_binary=True) == file.read_bytes(), "the inverse"
    (tmp_path / "a b.png").write_bytes(b"")
    file.write_bytes(joined_gltf(document | {"images": [{"uri": "a%20b.png"}]}, rest, is_binary=True))
    assert list(mesh_asset(file).files) == ["part.glb", "a b.png"]
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(ValueError, match="its header says"):
        mesh_asset(file)


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
RGB = ("red", "green", "blue")
LOST = {
    "missing library": ("a.obj", "mtllib no.mtl\nusemtl red\n" + OBJ, {}, "no.mtl"),
    "missing library of a mesh without usemtl": ("a.obj", "mtllib no.mtl\n" + OBJ, {}, "no.mtl"),
    "no library": ("a.obj", "usemtl red\n" + OBJ, {}, "'red'"),
    "unknown material": ("a.obj", "mtllib a.mtl\nusemtl red\n" + OBJ, {"a.mtl": "newmtl blue\n"}, "'red'"),
    "several materials": ("a.obj", "mtllib a.mtl\n" + OBJ, {"a.mtl": "newmtl blue\nnewmtl red\n"}, "2 materials"),
    "no coordinates": ("a.ply", ply_text(CUBE, comment="TextureFile p.png"), {"p.png": ""}, "texture coordinates"),
    "faces": ("a.ply", ply_text(CUBE, of_faces=[f"uchar {name}" for name in RGB], face="1 2 3"), {}, "faces"),
    "whole numbers": ("a.ply", ply_text(CUBE, [f"int {name}" for name in RGB], "1 2 3"), {}, "type int"),
    "STL": ("a.stl", "COLOR=abcd".ljust(84, "\0"), {}, "COLOR="),
    "an unknown image": ("a.gltf", gltf_with(None), {}, "basisu"),
}  # fmt: skip


@pytest.mark.parametrize("case", LOST.values(), ids=LOST)
def test_what_cannot_be_drawn_is_named(tmp_path: Path, case: tuple[str, str, dict[str, str], str]) -> None:
    mesh, text, others, word = case
    (lost,) = read_mesh(written(tmp_path, mesh, {mesh: text, **others})).lost
    assert word in lost


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".stl"])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_coordinates_are_finite(tmp_path: Path, suffix: str, number: float) -> None:
    vertices = CUBE.vertices.copy()
    read_mesh(write_mesh(tmp_path / f"part{suffix}", CUBE)).require_finite()
    vertices[5, 1] = number
    mesh = read_mesh(write_mesh(tmp_path / f"part{suffix}", Triangles(vertices, CUBE.corners)))
    with pytest.raises(ValueError, match=r"vertex \d+ is at .*expected finite"):
        mesh.require_finite()


@pytest.mark.parametrize("number", ["nan", "1e400", "1e39", "0,5", "x", "1.#QNAN", ""])
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.obj", "v 0.125 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("a.stl", "solid\nfacet normal 0 0 1\nouter loop\n  vertex 0.125 0 0\nvertex 1 0 0\nvertex 0 1 0\n"),
        ("a.ply", ply_text(Triangles(np.array([[0.125, 0, 0]]), np.array([[0, 0, 0]])), ("float nx",), "nan")),
    ],
)
def test_coordinates_of_text_are_numbers(tmp_path: Path, name: str, text: str, number: str) -> None:
    """Normals may be any: Blender computes its own."""
    read_mesh(written(tmp_path, name, {name: text})).require_finite()
    mesh = read_mesh(written(tmp_path, name, {name: text.replace("0.125", number)}))
    if (name, number) != ("a.ply", ""):  # a shorter row has still three columns
        with pytest.raises(ValueError, match=r"expected finite|cannot be read"):
            mesh.require_finite()


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
@pytest.mark.parametrize(
    "document",
    [
        [],
        {"asset": {"version": "1.0"}},
        {"nodes": 3},
        {"scenes": [{}], "scene": 2},
        {"meshes": [{}]},
        {"buffers": [{"uri": "no.bin"}]},
    ],
)
def test_a_strange_document_is_one_line(tmp_path: Path, suffix: str, document: Any) -> None:
    document = GLTF | document if isinstance(document, dict) else document
    (tmp_path / f"a{suffix}").write_bytes(joined_gltf(document, b"", is_binary=suffix == ".glb"))
    with pytest.raises(ValueError, match=rf"cannot be read as {suffix} \("):
        mesh_asset(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("order", ["little", "big"])
def test_rows_of_a_binary_ply_may_have_other_columns(tmp_path: Path, order: str) -> None:
    head = f"ply\nformat binary_{order}_endian 1.0\nelement vertex 2\nproperty double x\nproperty float y\n"
    head += "property float z\nproperty uchar red\nproperty int label\nend_header\n"
    rows = [struct.pack(f"{'<>'[order == 'big']}dffBi", x, 2.0, 3.0, 7, -1) for x in (1.0, np.nan)]
    (tmp_path / "a.ply").write_bytes(head.encode() + b"".join(rows))
    with pytest.raises(ValueError, match=r"vertex 2 is at \[nan, 2\.0, 3\.0\]"):
        read_mesh(tmp_path / "a.ply").require_finite()


def test_an_obj_is_text_in_utf_8(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(OBJ, "utf-16")
    with pytest.raises(ValueError, match=r"cannot be read as \.obj .*expected UTF-8"):
        mesh_asset(tmp_path / "a.obj")
