"""The documents of glTF: read, written, and reduced to the default scene at rest."""

import json
import re
import struct
from typing import Any

from phd_exp.records.parsing import parse_json


def split_gltf(content: bytes) -> tuple[Any, bytes]:
    """The document of a .gltf or .glb file, and what follows it. Raises ValueError if the file is neither."""
    if not content.startswith(b"glTF"):
        return parse_json(content.decode("utf-8-sig")), b""
    size, length = struct.unpack_from("<8xII", content)
    if size != len(content):
        raise ValueError(f"its header says {size} bytes; it has {len(content)}")
    return parse_json(content[20 : 20 + length].decode()), content[20 + length :]


def joined_gltf(document: Any, rest: bytes, *, is_binary: bool) -> bytes:
    """The file of a document, the inverse of `split_gltf`."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    return head + text + rest if is_binary else text


def keep_default_scene_at_rest(document: Any) -> None:
    """Remove other scenes, invisible nodes, animations and morph targets.

    Extensions of visibility and textures are no longer required: the geometry is complete without them.
    """
    nodes, scenes = document.get("nodes", []), document.get("scenes")
    children = {child for node in nodes for child in node.get("children", ())}
    roots = scenes[document.get("scene", 0)].get("nodes", ()) if scenes else set(range(len(nodes))) - children
    left, drawn = list(roots), set()
    while left:
        node = nodes[number := left.pop()]
        if node.get("extensions", {}).get("KHR_node_visibility", {}).get("visible", True) and number not in drawn:
            drawn.add(number)
            left += node.get("children", ())
    for number, node in enumerate(nodes):
        for key in ("weights",) if number in drawn else ("mesh", "skin", "weights", "extensions"):
            node.pop(key, None)
    for mesh in document.get("meshes", ()):
        mesh.pop("weights", None)
        for primitive in mesh["primitives"]:
            primitive.pop("targets", None)
    document.pop("animations", None)
    required = document.get("extensionsRequired", ())
    document["extensionsRequired"] = [name for name in required if not re.search("visibility|texture", name)]
