"""What the file of a mesh names, and a copy of it for Blender, without what moves or is hidden."""

import json
import os
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote, unquote

from phd_exp.records.parsing import parse_json

MATERIALS = "materials.mtl"  # which the copy of an OBJ names
BOM = b"\xef\xbb\xbf"
_OBJ_LINE = re.compile(rb"^[ \t]*(mtllib|usemtl)\b[ \t]*(.*?)[ \t\r]*$", re.M)
_NEW_MATERIAL = re.compile(rb"^[ \t]*newmtl[ \t]+(.*?)[ \t\r]*$", re.M)
_OPTION = rb"-type[ \t]+\w+[ \t]+|-\w+(?:[ \t]+(?:on|off|[rgbmlz]|[-+]?[\d.]+(?:e[-+]?\d+)?)(?=[ \t]))*[ \t]+"
_MAP = re.compile(
    rb"^([ \t]*(?:map_(?!aat)\w+|bump|disp|decal|refl|norm)[ \t]+(?:%b)*)(.+?)[ \t\r]*$" % _OPTION, re.M | re.I
)
_PLY_NAMES = {b"r": b"red", b"g": b"green", b"b": b"blue", b"a": b"alpha", b"u": b"s", b"v": b"t"}
_PLY_NAMES |= {b"texture_u": b"s", b"texture_v": b"t"}
_PLY_NAMES |= {b"diffuse_" + name: name for name in (b"red", b"green", b"blue", b"alpha")}
"""Names that Blender knows of properties of vertices."""


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
    """

    path: Path
    copy: bytes
    materials: bytes = b""
    texture: Path | None = None
    files: list[Path] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)

    def find(self, name: str, folder: Path) -> Path | None:
        """The file that a text in `folder` names, perhaps with Windows' separators or a place on another machine."""
        plain = unquote(name.strip("\"'")).replace("\\", "/")
        for candidate in (name, plain, PurePosixPath(plain).name):
            if candidate and os.path.isfile(path := folder / candidate):
                self.files += [path] if path not in self.files else []
                return path.absolute()
        self.lost.append(f"{name} is missing")
        return None


def read_mesh(path: Path) -> MeshFile:
    """Read the file of a mesh, and the MTL files of an OBJ.

    Raises:
        ValueError: it is invalid, or a part of its geometry is missing.
        OSError: a file cannot be read.
    """
    mesh, suffix = MeshFile(path, path.read_bytes()), path.suffix.lower()
    read = {".glb": _read_gltf, ".gltf": _read_gltf, ".obj": _read_obj, ".ply": _read_ply, ".stl": _read_stl}[suffix]
    try:
        read(mesh)
    except (AttributeError, LookupError, TypeError, ValueError, struct.error) as error:  # a stranger's structure
        raise ValueError(f"cannot be read as {suffix} ({error})") from None
    return mesh


def split_gltf(content: bytes) -> tuple[dict[str, Any], bytes]:
    """The document of a glTF file, and the binary chunks of a .glb. Raises ValueError if it is none."""
    if not content.startswith(b"glTF"):
        return parse_json(content.decode("utf-8-sig")), b""
    size, length = struct.unpack_from("<8xII", content)
    if size != len(content):
        raise ValueError(f"its header says {size} bytes; it has {len(content)}")
    return parse_json(content[20 : 20 + length].decode()), content[20 + length :]


def _read_gltf(mesh: MeshFile) -> None:
    document, binary = split_gltf(mesh.copy)
    for key in ("buffers", "images"):
        for item in document.get(key, ()):
            uri = item.get("uri", "data:")
            if not uri.startswith("data:") and (path := mesh.find(unquote(uri), mesh.path.parent)):
                item["uri"] = quote(str(path))
        if key == "buffers" and mesh.lost:
            raise ValueError(f"{mesh.lost[0]}; put it where the file names it")
    for texture in document.get("textures", ()):
        if "source" not in texture and "EXT_texture_webp" not in (kinds := texture.get("extensions", {})):
            mesh.lost.append(f"a texture has no image that is read ({', '.join(kinds)})")
    _keep_default_scene(document)
    _keep_rest(document)
    text = json.dumps(document).encode()
    if mesh.copy.startswith(b"glTF"):
        text += b" " * (-len(text) % 4)
        size = 20 + len(text) + len(binary)
        text = struct.pack("<4sIII4s", b"glTF", 2, size, len(text), b"JSON") + text + binary
    mesh.copy = text


def _keep_default_scene(document: dict[str, Any]) -> None:
    """Remove the meshes of nodes that are invisible or outside the default scene, if there is one."""
    nodes, scenes = document.get("nodes", []), document.get("scenes")
    children = {child for node in nodes for child in node.get("children", ())}
    roots = scenes[document.get("scene", 0)].get("nodes", ()) if scenes else set(range(len(nodes))) - children
    left, drawn = list(roots), set()
    while left:
        number = left.pop()
        node = nodes[number]
        visible = node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True)
        if visible and number not in drawn:
            drawn.add(number)
            left += node.get("children", ())
    for number, node in enumerate(nodes):
        for key in ("mesh", "skin", "extensions") if number not in drawn else ():
            node.pop(key, None)


def _keep_rest(document: dict[str, Any]) -> None:
    """Remove animations and morph targets, and the demand for extensions without which the geometry is complete."""
    document.pop("animations", None)
    for item in (*document.get("nodes", ()), *document.get("meshes", ())):
        item.pop("weights", None)
        for primitive in item.get("primitives", ()):
            primitive.pop("targets", None)
    demanded = document.get("extensionsRequired", ())
    document["extensionsRequired"] = [name for name in demanded if not re.search("visibility|texture", name)]


def _read_obj(mesh: MeshFile) -> None:
    text = mesh.copy.removeprefix(BOM)
    lines = _OBJ_LINE.findall(text)
    used = {name for word, name in lines if word == b"usemtl"}
    named = [os.fsdecode(name) for word, name in lines if word == b"mtllib"]
    if used and not named and mesh.path.with_suffix(".mtl").is_file():  # which Blender reads
        named = [f"{mesh.path.stem}.mtl"]
    for name in named:
        for part in re.findall(r"\S.*?\.mtl(?=\s|$)|\S.*", name, re.I):  # several on one line
            if path := mesh.find(part, mesh.path.parent):
                mesh.materials += _read_mtl(mesh, path)
    known = set(_NEW_MATERIAL.findall(mesh.materials))
    if not mesh.lost:
        mesh.lost += [f"no material is named {os.fsdecode(name)!r}" for name in sorted(used - known)]
    if not used and len(known) > 1:
        mesh.lost.append(f"no usemtl says which of {len(known)} materials it has")
    only = b"usemtl %b\n" % known.pop() if not used and len(known) == 1 else b""
    mesh.copy = b"mtllib %b\n" % MATERIALS.encode() + only + re.sub(rb"(?m)^[ \t]*mtllib\b.*$", b"", text)


def _read_mtl(mesh: MeshFile, path: Path) -> bytes:
    """The content of an MTL file with absolute names of textures."""

    def absolute(match: re.Match[bytes]) -> bytes:
        found = mesh.find(os.fsdecode(match[2]), path.parent)
        return match[1] + os.fsencode(found) if found else match[0]

    return _MAP.sub(absolute, path.read_bytes().removeprefix(BOM)) + b"\n"


def _read_ply(mesh: MeshFile) -> None:
    head, end, body = mesh.copy.partition(b"end_header")
    sections = {part.split()[1]: part for part in re.split(rb"(?m)^(?=element\b)", head)}
    vertex = re.sub(rb"(?m)\w+(?=\s*$)", lambda name: _PLY_NAMES.get(name[0], name[0]), sections[b"vertex"])
    mesh.copy = head.replace(sections[b"vertex"], vertex) + end + body
    types = dict(reversed(words.split()[-2:]) for words in re.findall(rb"property .+", vertex))
    for name in re.findall(rb"(?im)^comment[ \t]+TextureFile[ \t]+(.*?)\s*$", head):
        mesh.texture = mesh.find(os.fsdecode(name), mesh.path.parent)
        if b"t" not in types:
            mesh.lost.append(f"vertices have no texture coordinates (s, t) for {os.fsdecode(name)}")
    if b" red" in sections.get(b"face", b"") and not {b"red", b"t"} & types.keys():
        mesh.lost.append("colours of faces are not read; expected colours of vertices")
    if b"int" in types.get(b"red", b"") and types[b"red"] not in (b"uint8", b"uint16"):
        mesh.lost.append(f"colours of vertices are of type {types[b'red'].decode()}; expected uchar")


def _read_stl(mesh: MeshFile) -> None:
    if b"COLOR=" in mesh.copy[:80]:
        mesh.lost.append("colours of faces (COLOR=) are not read")
