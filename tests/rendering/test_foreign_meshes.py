"""What is drawn of a mesh is what is labelled, and what its file names is drawn."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from phd_exp.records.errors import RenderError
from phd_exp.records.gltf import joined_gltf, split_gltf
from phd_exp.records.mesh_files import read_mesh
from phd_exp.rendering import importing
from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.objects import sample_object_scene
from phd_exp.rendering.rays import NOTHING, trace_pixels
from phd_exp.rendering.triangles import Triangles
from tests.support.meshes import Y_UP, ply_text, solid, write_mesh
from tests.support.renders import SMALL_MESH, MakeSpec

Change = Callable[[dict[str, Any]], None]
CUBE = solid("cube")
AT_MIDDLES = Settings(samples=1, denoised=False, points=1)
SIZE = pytest.approx((0.2, 0.2, 0.2), abs=1e-6)
COLOURS = [f"uchar {name}" for name in ("diffuse_red", "diffuse_green", "diffuse_blue")]
SHORT = [f"uchar {name}" for name in "rgba"]


@pytest.fixture
def drawn(of_mesh: MakeSpec) -> Callable[..., tuple[Renderer, np.ndarray]]:
    """A renderer of a mesh, and the mean colour of its opaque pixels, which are those of its labels."""

    def drawn(file: Path, index: int = 0, **changes: Any) -> tuple[Renderer, np.ndarray]:
        spec = of_mesh(mesh=str(file), **SMALL_MESH, **changes)
        renderer = Renderer(AT_MIDDLES, spec)
        scene = sample_object_scene(spec, "train", index, renderer.meshes)
        light = renderer.render(scene)
        opaque = light[..., 3] > 0.5
        assert opaque.sum() > 100
        assert (opaque != (trace_pixels(scene, renderer.meshes).surfaces[0] != NOTHING)).sum() <= 5
        return renderer, light[opaque][:, :3].mean(axis=0)

    return drawn


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj", ".ply", ".stl"])
def test_every_format_gives_the_same_object_whatever_its_unit(tmp_path: Path, drawn: Callable, suffix: str) -> None:
    """The reference point is in the file's axes and units; Blender draws what geometry says."""
    middle = (0.03, -0.02, 0.05)
    file = write_mesh(tmp_path / f"part{suffix}", solid("cylinder", 0.2, middle), per_metre=1000)
    x, y, z = (1000 * value for value in middle)
    point = (x, z, -y) if suffix in Y_UP else (x, y, z)
    for index, (reference, away) in enumerate(((point, (0, 0, 0)), ("centroid", (0, 0, 0)), ("origin", middle))):
        renderer, _ = drawn(file, index, reference=reference, unit=0.001)
        expected = solid("cylinder", 0.2, away).vertices
        assert bounds(renderer) == pytest.approx([*expected.min(axis=0), *expected.max(axis=0)], abs=1e-6)


def bounds(renderer: Renderer) -> list[float]:
    vertices = renderer.meshes["mesh"].vertices
    return [*vertices.min(axis=0), *vertices.max(axis=0)]


def scaled_with_targets(document: dict[str, Any]) -> None:
    document["nodes"] = [{"mesh": 0, "scale": [0.1, 0.1, 0.1]}]
    document["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 0}]
    document["meshes"][0]["weights"] = [1.0]


def animated(document: dict[str, Any]) -> None:
    """To (0.1, 0.1, 0.1), which are numbers of the vertices."""
    document["accessors"] += [
        {"bufferView": 1, "componentType": 5126, "count": 1, "type": "SCALAR", "min": [0], "max": [0]},
        {"bufferView": 0, "componentType": 5126, "count": 1, "type": "VEC3"},
    ]
    channel = {"sampler": 0, "target": {"node": 0, "path": "translation"}}
    document["animations"] = [{"samplers": [{"input": 2, "output": 3}], "channels": [channel]}]
    document["nodes"] = [{"mesh": 0, "scale": [0.1, 0.1, 0.1]}]


def two_scenes(document: dict[str, Any]) -> None:
    small = {"mesh": 0, "scale": [0.1, 0.1, 0.1]}
    document |= {"nodes": [small | {"translation": [1, 0, 0]}, small]}
    document |= {"scenes": [{"nodes": [0]}, {"nodes": [1]}], "scene": 1}


def partly_invisible(document: dict[str, Any]) -> None:
    """Also without scenes, where every node without a parent is shown."""
    two_scenes(document)
    del document["scenes"], document["scene"]
    document["extensionsRequired"] = ["KHR_node_visibility"]
    document["nodes"][0]["extensions"] = {"KHR_node_visibility": {"visible": False}}


def partly_transparent(document: dict[str, Any]) -> None:
    """The far part has a material whose alpha is 0."""
    two_scenes(document)
    document |= {"scenes": [{"nodes": [0, 1]}], "scene": 0}
    glass = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0]}, "alphaMode": "BLEND"}
    document["materials"] = [glass, {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}]
    (primitive,) = document["meshes"][0]["primitives"]
    document["meshes"] = [{"primitives": [primitive | {"material": number}]} for number in range(2)]
    document["nodes"][1]["mesh"] = 1


def turned_parent(document: dict[str, Any]) -> None:
    turn = {"children": [1], "rotation": [0, 0, 0.5**0.5, 0.5**0.5], "scale": [0.1, 0.1, 0.1]}
    document["nodes"] = [turn, {"mesh": 0, "translation": [1, 0, 0]}]


def one_mirrored(document: dict[str, Any]) -> None:
    """Two instances; the axes of glTF are (x, y, z) = (x, z, -y) of the local frame."""
    nodes = [{"mesh": 0, "translation": [0, 0, 10]}, {"mesh": 0, "scale": [-1, 2, 1]}]
    document["nodes"] = [{"children": [1, 2], "scale": [0.1, 0.1, 0.1]}, *nodes]


PLAIN = [-0.1, -0.1, -0.1, 0.1, 0.1, 0.1]
CHANGES: list[tuple[Change, list[float]]] = [
    *(
        (change, PLAIN)
        for change in (scaled_with_targets, animated, two_scenes, partly_invisible, partly_transparent)
    ),
    (turned_parent, [-0.1, -0.1, 0.0, 0.1, 0.1, 0.2]),
    (one_mirrored, [-0.1, -1.1, -0.2, 0.1, 0.1, 0.2]),
]


@pytest.mark.parametrize(("change", "expected"), CHANGES)
@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_what_is_drawn_is_what_is_labelled(
    tmp_path: Path, drawn: Callable, suffix: str, change: Change, expected: list[float]
) -> None:
    """The visible parts of the default scene at rest, as one object."""
    file = write_mesh(tmp_path / f"part{suffix}", CUBE, per_metre=10)
    document, rest = split_gltf(file.read_bytes())
    change(document)
    file.write_bytes(joined_gltf(document, rest, is_binary=suffix == ".glb"))
    assert bounds(drawn(file)[0]) == pytest.approx(expected, abs=1e-6)


def test_points_outside_all_faces_do_not_count(tmp_path: Path, drawn: Callable) -> None:
    file = write_mesh(
        tmp_path / "part.ply", Triangles(np.concatenate([[[9.0, 9, 9]], CUBE.vertices]), CUBE.corners + 1)
    )
    renderer, _ = drawn(file)
    assert renderer.meshes["mesh"].dimensions == SIZE


def test_a_polygon_that_is_not_flat_is_labelled_as_it_is_drawn(tmp_path: Path, drawn: Callable) -> None:
    """There are several ways to divide this one into triangles, which show different silhouettes."""
    corners = [(-1, 0, 1), (1, 0, 1), (1, 0, -1), (-1, 0, -1), (0, 1, -1)]
    file = tmp_path / "tent.obj"
    file.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3 4 5\n")
    drawn(file, index=1, unit=0.1)


def red(path: Path) -> None:
    Image.new("RGB", (8, 8), (200, 0, 0)).save(path)


def obj(path: Path, head: str, mtl: str) -> Path:
    write_mesh(path, CUBE)
    path.with_suffix(".mtl").write_text(mtl)
    path.write_text(head + "vt 0 0\n" + path.read_text())
    return path


def test_colours_and_textures_are_drawn(tmp_path: Path, drawn: Callable) -> None:
    red(tmp_path / "my red.png")
    files = {
        "texture_u": ply_text(CUBE, ("float texture_u", "float texture_v"), "0 0", comment="TextureFile my red.png"),
        "s": ply_text(CUBE, ("float s", "float t"), "0 0", comment="TextureFile my red.png").replace("\n", "\r\n"),
        "diffuse": ply_text(CUBE, COLOURS, "200 0 0"),
        "short": ply_text(CUBE, SHORT, "200 0 0 255"),
        "plain": ply_text(CUBE, [f"uchar {name}" for name in ("red", "green", "blue")], "200 0 0"),
    }
    meshes = [tmp_path / f"{name}.ply" for name in files]
    for path, text in zip(meshes, files.values(), strict=True):
        path.write_bytes(text.encode())
    meshes.append(obj(tmp_path / "no usemtl.obj", "mtllib .\\no usemtl.mtl\n", "newmtl only\nmap_Kd my red.png\n"))
    for mesh in meshes:
        renderer, colour = drawn(mesh)
        assert colour[0] > 5 * max(colour[1:]), mesh.name
        assert renderer.meshes["mesh"].dimensions == SIZE
        _, plain = drawn(mesh, ignore=["materials"])
        assert colour[0] < 5 * max(plain[1:]), "the scene's own colour"


PLATE = """ply
format ascii 1.0
comment TextureFile fine.png
element vertex 4
property float x
property float y
property float z
property float s
property float t
element face 1
property list uchar int vertex_indices
end_header
-0.1 -0.1 0 0 0
0.1 -0.1 0 1 0
0.1 0.1 0 1 1
-0.1 0.1 0 0 1
4 0 1 2 3
"""


def test_a_texture_much_finer_than_the_image_is_no_noise(tmp_path: Path, of_mesh: MakeSpec) -> None:
    """A plate printed with random dots, nine or more to a pixel, is grey even at one point of each pixel."""
    dots = 255 * np.random.default_rng(0).integers(0, 2, (1024, 1024, 1)).repeat(3, axis=2).astype(np.uint8)
    Image.fromarray(dots).save(tmp_path / "fine.png")
    (tmp_path / "plate.ply").write_text(PLATE)
    spec = of_mesh(mesh=str(tmp_path / "plate.ply"), **SMALL_MESH)
    renderer = Renderer(Settings(samples=256, denoised=False, points=1), spec)
    light = renderer.render(sample_object_scene(spec, "train", 0, renderer.meshes))
    shown = light[..., 0][light[..., 3] > 0.5]
    assert len(shown) > 100
    assert shown.std() < 0.25 * shown.mean()


def coloured(path: Path, colours: list[str]) -> Path:
    """An OBJ whose vertices have colours."""
    lines = write_mesh(path, CUBE).read_text().splitlines()
    path.write_text("\n".join([*map("".join, zip(lines, colours, strict=False)), *lines[8:], ""]))
    return path


USED = "mtllib a.mtl\nusemtl red\n"
REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "lost": (lambda path: obj(path, USED, "newmtl blue\n"), "no material is named 'red'"),
    "clear": (lambda path: obj(path, USED, "newmtl red\nd 0\n"), "transparent everywhere"),
    "broken": (lambda path: obj(path, USED, "newmtl red\nmap_Kd a.mtl\n"), r"a\.mtl cannot be read"),
    "missing": (lambda path: obj(path, USED, "newmtl red\nmap_Kd wood.png\n"), r"wood\.png is missing"),
    "large": (lambda path: coloured(path, [" 255 128 0"] * 8), "its colours reach"),
    "few": (lambda path: coloured(path, [" 1 0 0", *[""] * 7]), "colours of its vertices cannot be read"),
    "nan": (lambda path: coloured(path, [*[" 1 0 0"] * 7, " nan nan nan"]), "colours of its vertices cannot be read"),
}


@pytest.mark.parametrize(("write", "message"), REFUSED.values(), ids=REFUSED)
def test_colours_that_cannot_be_drawn_are_refused_or_ignored(
    tmp_path: Path, drawn: Callable, write: Callable[[Path], Path], message: str
) -> None:
    file = write(tmp_path / "a.obj")
    with pytest.raises(RenderError, match=rf"^data\.mesh: a\.obj: .*{message}.*data\.ignore=\[materials\]"):
        drawn(file)
    drawn(file, ignore=["materials"])


def test_a_mesh_that_blender_draws_elsewhere_is_refused(
    tmp_path: Path, drawn: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the reason: here, shape keys that the copy still has."""
    original = importing._one_object

    def with_shape_keys(*args: Any, **options: Any) -> Any:
        handle = original(*args, **options)
        handle.shape_key_add(name="basis")
        return handle

    monkeypatch.setattr(importing, "_one_object", with_shape_keys)
    with pytest.raises(RenderError, match="Blender draws other triangles than its labels have"):
        drawn(write_mesh(tmp_path / "a.stl", CUBE, per_metre=1000), unit=0.001)


def test_the_reason_of_blenders_error_is_told(tmp_path: Path, drawn: Callable) -> None:
    file = write_mesh(tmp_path / "a.gltf", CUBE)
    wanted = {"extensionsRequired": ["KHR_any"], "extensionsUsed": ["KHR_any"]}
    file.write_text(json.dumps(json.loads(file.read_text()) | wanted))
    with pytest.raises(RenderError, match="KHR_any") as error:
        drawn(file)
    (tmp_path / "a.stl").write_text("no mesh")
    with pytest.raises(RenderError, match=r"Failed to read.*a\.stl") as other:
        drawn(tmp_path / "a.stl")
    for text in (str(error.value), str(other.value)):
        assert not re.search(r"Location|\.py|/tmp", text)


BOTTLE = (
    b"# This file uses centimeters as units for non-parametric coordinates.\n"
    b"v 0 0 0\nv 0 0 3\nv 0 14.9 0\nv 0 14.9 3\nf 1 2 4 3\n"
)


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("# This file uses centimeters as units", 0.01),
        ("# File units = Millimetres", 0.001),
        ("#Units: mm", 0.001),
        ("# units inches", 0.0254),
        ("# File units = meters", 1.0),
        ("# made for a diameter of 5 mm", None),
        ("v 0 0 0 # unit cm", None),
    ],
)
def test_the_unit_that_an_obj_states(tmp_path: Path, text: str, unit: float | None) -> None:
    (tmp_path / "a.obj").write_text(f"# exported\n{text}\nv 0 0 0\n")
    assert read_mesh(tmp_path / "a.obj").stated_unit == unit


OBJ = {"no faces": b"v 0 0 0\n", "a line": b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "bottle": BOTTLE}
SHORT_PLY = b"ply\nformat ascii 1.0\nelement face 10000000\nend_header\n"
BY_UNIT = r"longest side is 200 m, .* set data\.unit=0\.001 \(0\.2 m\) or 0\.01 \(2 m\)$"
UNUSABLE: list[tuple[str, Any, dict[str, Any], str]] = [
    ("a.obj", OBJ["no faces"], {}, "has no faces; expected a surface"),
    ("a.obj", OBJ["a line"], {}, "its faces have no area"),
    ("a.obj", OBJ["bottle"], {}, r"data\.unit=0\.001 .* or 0\.01 \(0\.149 m, as the file states\) or 0\.0254 \(0"),
    ("a.ply", SHORT_PLY, {}, "a.ply: "),
    ("a.stl", solid("cylinder", 200.0), {}, BY_UNIT),
    ("a.stl", solid("cylinder", 1e-4), {}, r"longest side is 0\.0001 m, .*; no usual unit leads there$"),
    (
        "a.stl",
        solid("cylinder", 4.3),
        {},
        r"3\.04 m from the .* depth, 3 m; .*0\.01 \(0\.043 m\).*, or data\.z_range",
    ),
    ("a.stl", solid("cylinder", 2.4), {"scale_range": (0.5, 2.0)}, r"point 3\.39 m.* or data\.z_range above 3\.56 m"),
    ("a.stl", solid("cylinder", 0.2, (50, 0, 0)), {}, r"side is 0\.2 m, .* set data\.reference=centroid$"),
    ("a.stl", solid("cylinder", 0.2, (5e4, 0, 0)), {"reference": "centroid"}, r"reach 5e\+04 units, .* move it"),
]


@pytest.mark.parametrize(("name", "content", "changes", "message"), UNUSABLE)
def test_an_unusable_mesh_is_one_line(
    of_mesh: MakeSpec, tmp_path: Path, name: str, content: Any, changes: dict[str, Any], message: str
) -> None:
    file = tmp_path / name
    file.write_bytes(content) if isinstance(content, bytes) else write_mesh(file, content)
    with pytest.raises(RenderError, match=rf"^data\.mesh: {name}: [^\n]*") as error:
        Renderer(AT_MIDDLES, of_mesh(mesh=str(file), **changes))
    assert re.search(message, str(error.value))
    assert "\n" not in str(error.value)
