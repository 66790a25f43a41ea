"""The user's meshes in Blender's scene: read by Blender's importers, joined, and measured in metres.

Functions receive Blender's module; this file does not import it.
"""

import io
import tempfile
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phd_exp.optics.virtual import product
from phd_exp.records.errors import RenderError, listed, one_line
from phd_exp.records.mesh_files import MATERIALS, MeshFile, read_mesh
from phd_exp.records.spec import NEAREST, DatasetSpec
from phd_exp.rendering.stage import copy_name
from phd_exp.rendering.triangles import Meshes, Triangles

TEXELS = 4  # of a texture along a side of an image: Cycles takes its value at a point, so finer ones are noise
MOST_FACES = 1_000_000
SIZES = (0.001, 20.0)  # m: bounds of an object's longest side
UNITS = (0.001, 0.01, 0.0254, 1.0)  # m: in which files may be
TOLERANCE = 1e-3  # of an object's size, within which what is drawn and what is labelled agree
PLAIN = "set data.ignore=[materials] for random colours"
Y_UP = (".glb", ".gltf", ".obj")  # Blender turns their (x, y, z) to (x, -z, y)


def import_meshes(bpy: Any, spec: DatasetSpec) -> Meshes:
    """Add the objects `mesh`, `mesh1`, ... of a specification and its copies to Blender's scene.

    Returns the triangles of the objects.

    Raises RenderError if a file or its texture cannot be read, has no faces or too many, or is of another size than
    its unit and the data's depths allow.
    """
    meshes = {}
    for number, asset in enumerate(filter(None, (spec.mesh, *spec.distractor_meshes))):
        file, name = next(iter(asset.files)), f"mesh{number or ''}"
        try:
            read = read_mesh(asset.path(file))
            handle = _one_object(bpy, read, is_plain="materials" in spec.ignore)
            reference = "centroid" if number else spec.reference
            if isinstance(reference, tuple):
                reference = in_blenders_axes(reference, file)
            meshes[name] = _in_metres(handle, spec.unit, reference)
            _require_drawn(bpy, handle, meshes[name])
            _require_size(meshes[name], spec, read.stated_unit)
        except (OSError, ValueError, RuntimeError) as error:
            key = "distractor_meshes" if number else "mesh"
            raise RenderError(f"data.{key}: {file}: {one_line(str(error))}") from None
        handle.name = name
    for number in range(1, spec.copies + 1):
        copy = bpy.data.objects["mesh"].copy()
        copy.name = copy_name("mesh", number)
        bpy.context.scene.collection.objects.link(copy)
    _shrink_textures(bpy, TEXELS * spec.sensor_size)
    return meshes


def _shrink_textures(bpy: Any, largest: int) -> None:
    """Halve textures until their longer side has at most `largest` pixels."""
    for image in bpy.data.images:
        if max(image.size) <= largest:
            continue
        while max(image.size) > largest:  # each time the mean of two pixels along both sides
            image.scale(max(1, image.size[0] // 2), max(1, image.size[1] // 2))
        image.pack()  # otherwise Cycles reads the file


def _one_object(bpy: Any, file: MeshFile, *, is_plain: bool) -> Any:
    """Import a file and join its parts, in the pose of rest; lamps, cameras and empties are removed.

    If it is to be plain, its materials are removed too.
    """
    if file.lost and not is_plain:
        raise ValueError(f"{listed(file.lost)}; correct the file, or {PLAIN}")
    added = _import(bpy, file)
    parts = sorted((item for item in added if item.type == "MESH" and item.data.polygons), key=lambda item: item.name)
    if not (faces := sum(len(part.data.polygons) for part in parts)):
        raise ValueError("has no faces; expected a surface of polygons, not points or lines")
    if faces > MOST_FACES:
        raise ValueError(
            f"has {faces} faces; expected at most {MOST_FACES}; Blender's modifier Decimate removes some"
        )
    bpy.context.view_layer.update()
    whole, others = parts[0], added - set(parts)
    if len(parts) > 1:
        with bpy.context.temp_override(active_object=whole, selected_editable_objects=parts):
            bpy.ops.object.join()
    whole.modifiers.clear()
    for item in others:
        bpy.data.objects.remove(item)
    _paint_all(bpy, whole.data, file, is_plain=is_plain)
    return whole


def _paint_all(bpy: Any, mesh: Any, file: MeshFile, *, is_plain: bool) -> None:
    """Remove a mesh's materials, or require that all that its file names is drawn. Raises ValueError."""
    if not is_plain and not mesh.color_attributes and file.has_colours():
        raise ValueError(f"colours of its vertices cannot be read; expected three numbers of each; {PLAIN}")
    if is_plain or not any(mesh.materials):
        mesh.materials.clear()
        mesh.materials.append(None if is_plain else _paint(bpy, mesh, file.texture))
    if not is_plain and (broken := [i.name for i in bpy.data.images if i.source == "FILE" and not i.size[0]]):
        raise ValueError(f"its texture {listed(broken)} cannot be read; replace it, or {PLAIN}")


def _import(bpy: Any, file: MeshFile) -> set[Any]:
    """Let Blender read the copy of a file; returns the new objects."""
    before, suffix = set(bpy.data.objects), file.path.suffix.lower()
    file.require_finite()
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()):  # where Blender reports progress
        path = Path(folder, file.path.name)
        path.write_bytes(file.copy)
        path.with_name(MATERIALS).write_bytes(file.materials)
        try:
            if suffix in (".glb", ".gltf"):
                bpy.ops.import_scene.gltf(filepath=str(path), disable_bone_shape=True)
            else:
                getattr(bpy.ops.wm, f"{suffix[1:]}_import")(filepath=str(path))
        except RuntimeError as error:
            lines = str(error).replace(f"{folder}/", "").splitlines()
            reasons = [line for line in lines if line.strip() and not line.startswith("Location:")]
            raise ValueError(
                f"Blender cannot read it ({reasons[-1].removeprefix('Error: ')}); export it again"
            ) from None
    return set(bpy.data.objects) - before


def in_blenders_axes(vector: tuple[float, float, float], file: str) -> tuple[float, float, float]:
    """A vector in the axes of a mesh's file in the local frame, whose z axis points up."""
    x, y, z = vector
    return (x, -z, y) if file.lower().endswith(Y_UP) else vector


def _in_metres(handle: Any, unit: float, reference: Any) -> Triangles:
    """Scale a mesh to metres, move its reference point to the origin, and return its triangles."""
    mesh = handle.data
    local, corners = _geometry(mesh)
    if not corners.size:
        raise ValueError(f"is transparent everywhere; expected opaque faces; {PLAIN}")
    used = np.unique(corners)
    far, size = np.abs(local[used]).max(), np.ptp(local[used], axis=0).max()
    if Triangles(local.astype(float), corners).areas.sum() <= (TOLERANCE * size) ** 2:
        raise ValueError("its faces have no area; expected a surface")
    if np.spacing(far) > TOLERANCE * size:
        raise ValueError(
            f"its coordinates reach {far:.3g} units, where 32-bit numbers are {np.spacing(far):.2g} apart, but it "
            f"measures only {size:.3g} units; move it to the origin"
        )
    world = np.array(handle.matrix_world)
    vertices = unit * (product(local, world[:3, :3].T) + world[:3, 3])
    if reference == "centroid":
        vertices -= Triangles(vertices, corners).centroid
    elif reference != "origin":
        vertices -= unit * np.array(reference)
    handle.parent = None
    handle.matrix_world = np.eye(4).tolist()
    mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
    mesh.update()
    # again, because rounding decides how Blender divides a polygon that is not flat
    used, places = np.unique(_geometry(mesh)[1], return_inverse=True)
    is_opaque = all(_alphas(material) in ({0.0}, {1.0}) for material in filter(None, mesh.materials))
    return Triangles(vertices[used], places.reshape(-1, 3).astype(np.int32), is_opaque)


def _geometry(mesh: Any) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices (n, 3) of Blender's mesh, and the three of each opaque triangle (m, 3)."""
    mesh.calc_loop_triangles()
    vertices, n = np.empty((len(mesh.vertices), 3), np.float32), len(mesh.loop_triangles)
    corners, slots = np.empty((n, 3), np.int32), np.empty(n, np.int32)
    mesh.vertices.foreach_get("co", vertices.ravel())
    mesh.loop_triangles.foreach_get("vertices", corners.ravel())
    mesh.loop_triangles.foreach_get("material_index", slots)
    opaque = np.array([_is_opaque(material) for material in mesh.materials] or [True])
    return vertices, corners[opaque[np.minimum(slots, len(opaque) - 1)]]


def _is_opaque(material: Any) -> bool:
    """Whether a material is seen at all: its alpha is not the constant 0."""
    return material is None or _alphas(material) != {0.0}


def _alphas(material: Any) -> set[float | None]:
    """The opacities of a material's shaders; None for one that varies."""
    shaders = [node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED"]
    alphas = [shader.inputs["Alpha"] for shader in shaders]
    return {None if alpha.is_linked else float(alpha.default_value) for alpha in alphas} or {1.0}


def _require_drawn(bpy: Any, handle: Any, mesh: Triangles) -> None:
    """Raise ValueError unless Blender draws the triangles where they are."""
    drawn = handle.evaluated_get(bpy.context.evaluated_depsgraph_get())
    world, (vertices, corners) = np.array(drawn.matrix_world), _geometry(drawn.data)
    points, labels = product(vertices[corners], world[:3, :3].T) + world[:3, 3], mesh.vertices[mesh.corners]
    near = TOLERANCE * max(mesh.dimensions)
    if points.shape != labels.shape or not np.allclose(points, labels, rtol=0, atol=near):
        raise ValueError("Blender draws other triangles than its labels have; export it without modifiers or poses")


def _require_size(mesh: Triangles, spec: DatasetSpec, stated: float | None) -> None:
    """Raise ValueError if a mesh is implausibly small or large, or may reach the camera.

    The error says which sizes other units lead to, and marks the one that the file states.
    """
    longest, reach, room = max(mesh.dimensions), spec.scale_range[1] * mesh.radius, spec.z_range[0] / NEAREST
    if (fits := SIZES[0] <= longest <= SIZES[1]) and reach <= room:
        return
    central = spec.scale_range[1] * Triangles(mesh.vertices - mesh.centroid, mesh.corners).radius
    factors = {unit: unit / spec.unit for unit in UNITS if unit != spec.unit}
    likely = {u: k for u, k in factors.items() if SIZES[0] <= k * longest <= SIZES[1] and k * central <= room}
    sizes = [f"{u:g} ({k * longest:.3g} m{', as the file states' * (u == stated)})" for u, k in likely.items()]
    remedies = []
    if fits and central <= room:
        remedies.append("data.reference=centroid")
    elif sizes:
        centred = " and data.reference=centroid" if reach * min(likely.values()) > room else ""
        remedies.append(f"data.unit={' or '.join(sizes)}{centred}")
    if fits and central > room:
        remedies.append(f"data.z_range above {NEAREST * reach:.3g} m")
    raise ValueError(
        f"its longest side is {longest:.3g} m, its farthest point {reach:.3g} m from the reference, with data.unit="
        f"{spec.unit:g}; expected {SIZES[0]:g} to {SIZES[1]:g} m, and less than the least depth, "
        f"{spec.z_range[0]:g} m; {'set ' + ', or '.join(remedies) if remedies else 'no usual unit leads there'}"
    )


def _paint(bpy: Any, mesh: Any, texture: Path | None) -> Any:
    """The material of a PLY's texture, or of the colours of vertices; None without either."""
    if texture is None and not mesh.color_attributes:
        return None
    material = bpy.data.materials.new("paint")
    nodes = material.node_tree.nodes
    node = nodes.new("ShaderNodeTexImage" if texture else "ShaderNodeVertexColor")
    if texture:
        node.image = bpy.data.images.load(str(texture))
    else:
        colours = mesh.color_attributes[0]
        values = np.empty(4 * len(colours.data), np.float32)
        colours.data.foreach_get("color", values)
        if values.max() > 1 + TOLERANCE:
            raise ValueError(f"its colours reach {values.max():.3g}; expected at most 1; {PLAIN}")
        node.layer_name = colours.name
    material.node_tree.links.new(node.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    return material
