"""The user's meshes in Blender's scene: read by Blender's importers, joined, measured.

Functions receive Blender's module; this file does not import it.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from phd_exp.records.assets import Asset
from phd_exp.records.errors import RenderError, gist
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.triangles import Depths, Meshes, Triangles

SIZES = (0.001, 20.0)  # m: bounds of an object's longest side
Y_UP = (".glb", ".gltf", ".obj")  # Blender turns their (x, y, z) to (x, -z, y)


def import_meshes(bpy: Any, spec: DatasetSpec) -> Meshes:
    """Add the objects `mesh`, `mesh1`, ... of a specification to Blender's scene; returns their triangles.

    Raises RenderError if a file cannot be read, has no faces, is not recorded with its place, or is of another size
    than its unit and the data's depths allow.
    """
    meshes = {}
    for number, asset in enumerate([spec.mesh, *spec.distractor_meshes]):
        assert asset is not None
        name, reference = f"mesh{number or ''}", "centroid" if number else spec.reference
        try:
            path = asset.path(asset.name)
            handle = _one_object(bpy, path)
            meshes[name] = _placed(handle.data, spec.unit, reference, is_y_up=path.suffix.lower() in Y_UP)
            _require_size(meshes[name], spec)
        except (ValueError, RuntimeError) as error:  # Blender's importers raise RuntimeError
            key = "data.distractor_meshes" if number else "data.mesh"
            raise RenderError(f"{key}: {asset.name}: {gist(error)}") from None
        handle.name = name
        _paint(bpy, handle.data)
    return meshes


def _one_object(bpy: Any, path: Path) -> Any:
    """Read a file and join its parts, in the pose of rest; lamps, cameras and empties are removed."""
    before = set(bpy.data.objects)
    match path.suffix.lower():
        case ".glb" | ".gltf":
            bpy.ops.import_scene.gltf(filepath=str(path), disable_bone_shape=True)
        case suffix:
            getattr(bpy.ops.wm, f"{suffix[1:]}_import")(filepath=str(path))
    added = set(bpy.data.objects) - before
    parts = sorted((item for item in added if item.type == "MESH" and item.data.polygons), key=lambda item: item.name)
    if not parts:
        raise ValueError("has no faces; expected a mesh of triangles or polygons")
    bpy.context.view_layer.update()
    whole = parts[0]
    if len(parts) > 1:
        with bpy.context.temp_override(active_object=whole, selected_editable_objects=parts):
            bpy.ops.object.join()
    _transform(whole.data, np.array(whole.matrix_world))
    whole.modifiers.clear()
    whole.animation_data_clear()
    whole.parent = None
    _remove(bpy, added - set(parts))
    return whole


def _remove(bpy: Any, objects: Iterable[Any]) -> None:
    for item in objects:
        bpy.data.objects.remove(item)


def _placed(mesh: Any, unit: float, reference: Any, *, is_y_up: bool) -> Triangles:
    """Scale a mesh to metres, move its reference point to the origin, and return its triangles."""
    _transform(mesh, np.diag([unit, unit, unit, 1.0]))
    if reference == "centroid":
        point = _triangles(mesh).centroid
    else:
        x, y, z = (0.0, 0.0, 0.0) if reference == "origin" else reference
        point = unit * np.array([x, -z, y] if is_y_up else [x, y, z])
    shift = np.eye(4)
    shift[:3, 3] = -point
    _transform(mesh, shift)
    return _triangles(mesh)


def _transform(mesh: Any, matrix: Depths) -> None:
    vertices = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", vertices)
    moved = vertices.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    mesh.vertices.foreach_set("co", moved.astype(np.float32).ravel())
    mesh.update()


def _triangles(mesh: Any) -> Triangles:
    mesh.calc_loop_triangles()
    vertices = np.empty(3 * len(mesh.vertices), np.float32)
    corners = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.vertices.foreach_get("co", vertices)
    mesh.loop_triangles.foreach_get("vertices", corners)
    return Triangles(vertices.reshape(-1, 3).astype(np.float64), corners.reshape(-1, 3))


def _require_size(mesh: Triangles, spec: DatasetSpec) -> None:
    """Raise ValueError if a mesh is implausibly small or large, or may reach half of the way to the camera."""
    longest, reach, nearest = max(mesh.dimensions), spec.scale_range[1] * mesh.radius, spec.z_range[0]
    advice = f"set data.unit={spec.unit / 1000:g} if the file is in millimetres"
    if not SIZES[0] <= longest <= SIZES[1]:
        other = advice if longest > SIZES[1] else f"set data.unit={spec.unit * 1000:g} if the file is in metres"
        raise ValueError(f"its longest side is {longest:.3g} m; expected {SIZES[0]:g} to {SIZES[1]:g} m; {other}")
    if not reach <= nearest / 2:
        raise ValueError(
            f"reaches {reach:.3g} m from its reference point; expected at most half of the least depth, "
            f"data.z_range[0]={nearest:g} m; {advice}, or move it away"
        )


def _paint(bpy: Any, mesh: Any) -> None:
    """Give a mesh without materials its vertices' colours, or an empty slot for the stage's materials."""
    if any(mesh.materials):
        return
    mesh.materials.clear()
    if not mesh.color_attributes:
        mesh.materials.append(None)
        return
    material = bpy.data.materials.new("vertices")
    tree = material.node_tree
    colour = tree.nodes.new("ShaderNodeVertexColor")
    colour.layer_name = mesh.color_attributes[0].name
    tree.links.new(colour.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    mesh.materials.append(material)
