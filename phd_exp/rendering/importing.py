"""The user's meshes in Blender's scene: read by Blender's importers, joined, and measured in metres.

Functions receive Blender's module; this file does not import it.
"""

import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from phd_exp.records.errors import RenderError, listed, one_line
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.triangles import Meshes, Triangles

MOST_FACES = 1_000_000
SIZES = (0.001, 20.0)  # m: bounds of an object's longest side
Y_UP = (".glb", ".gltf", ".obj")  # Blender turns their (x, y, z) to (x, -z, y)


def import_meshes(bpy: Any, spec: DatasetSpec) -> Meshes:
    """Add the objects `mesh`, `mesh1`, ... of a specification to Blender's scene; returns their triangles.

    Raises RenderError if a file or its texture cannot be read, has no faces or too many, or is of another size than
    its unit and the data's depths allow.
    """
    meshes = {}
    for number, asset in enumerate(filter(None, (spec.mesh, *spec.distractor_meshes))):
        file, name = next(iter(asset.files)), f"mesh{number or ''}"
        try:
            handle = _one_object(bpy, asset.path(file))
            reference = "centroid" if number else spec.reference
            meshes[name] = _in_metres(handle, spec.unit, reference, is_y_up=file.lower().endswith(Y_UP))
            _require_size(meshes[name], spec)
        except (ValueError, RuntimeError) as error:  # Blender's importers raise RuntimeError
            key, reason = "distractor_meshes" if number else "mesh", str(error).strip().splitlines()[-1]
            raise RenderError(f"data.{key}: {file}: {one_line(reason)}") from None
        handle.name = name
    return meshes


def _one_object(bpy: Any, path: Path) -> Any:
    """Read a file and join its parts, in the pose of rest; lamps, cameras and empties are removed."""
    before, suffix = set(bpy.data.objects), path.suffix.lower()
    with redirect_stdout(io.StringIO()):  # on which Blender tells how far it is
        if suffix in (".glb", ".gltf"):
            bpy.ops.import_scene.gltf(filepath=str(path), disable_bone_shape=True)
        else:
            getattr(bpy.ops.wm, f"{suffix[1:]}_import")(filepath=str(path))
    added = set(bpy.data.objects) - before
    parts = sorted((item for item in added if item.type == "MESH" and item.data.polygons), key=lambda item: item.name)
    if not 0 < (faces := sum(len(part.data.polygons) for part in parts)) <= MOST_FACES:
        raise ValueError(f"has {faces} faces; expected 1 to {MOST_FACES}; Blender's modifier Decimate removes some")
    if missing := [Path(image.filepath).name for image in bpy.data.images if image.filepath and not image.size[0]]:
        raise ValueError(f"its texture {listed(missing)} is missing; put it where the file names it")
    bpy.context.view_layer.update()
    whole, others = parts[0], added - set(parts)
    if len(parts) > 1:
        with bpy.context.temp_override(active_object=whole, selected_editable_objects=parts):
            bpy.ops.object.join()
    whole.modifiers.clear()
    whole.animation_data_clear()
    for item in others:
        bpy.data.objects.remove(item)
    if not any(whole.data.materials):
        whole.data.materials.clear()
        whole.data.materials.append(_vertex_colours(bpy, whole.data) if whole.data.color_attributes else None)
    return whole


def _in_metres(handle: Any, unit: float, reference: Any, *, is_y_up: bool) -> Triangles:
    """Scale a mesh to metres, move its reference point to the origin, and return its triangles."""
    mesh = handle.data
    mesh.calc_loop_triangles()
    local, corners = np.empty(3 * len(mesh.vertices), np.float32), np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.vertices.foreach_get("co", local)
    mesh.loop_triangles.foreach_get("vertices", corners)
    world = np.array(handle.matrix_world)
    vertices = unit * (local.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])
    triangles = Triangles(vertices, corners.reshape(-1, 3))
    if reference == "centroid":
        vertices -= triangles.centroid
    elif reference != "origin":
        x, y, z = reference
        vertices -= unit * np.array([x, -z, y] if is_y_up else [x, y, z])
    handle.parent = None
    mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    mesh.update()
    return triangles


def _require_size(mesh: Triangles, spec: DatasetSpec) -> None:
    """Raise ValueError if a mesh is implausibly small or large, or may reach half of the way to the camera."""
    longest, reach, nearest = max(mesh.dimensions), spec.scale_range[1] * mesh.radius, spec.z_range[0]
    unit = spec.unit * (1000 if longest < SIZES[0] else 0.001)
    if not (SIZES[0] <= longest <= SIZES[1] and reach <= nearest / 2):
        raise ValueError(
            f"its longest side is {longest:.3g} m, its farthest point {reach:.3g} m from the reference; expected "
            f"{SIZES[0]:g} to {SIZES[1]:g} m, and at most half of the least depth, {nearest / 2:g} m; set "
            f"data.unit={unit:g}, or data.z_range"
        )


def _vertex_colours(bpy: Any, mesh: Any) -> Any:
    material = bpy.data.materials.new("vertices")
    nodes = material.node_tree.nodes
    colour = nodes.new("ShaderNodeVertexColor")
    colour.layer_name = mesh.color_attributes[0].name
    material.node_tree.links.new(colour.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    return material
