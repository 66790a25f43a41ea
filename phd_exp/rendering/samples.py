"""One sample: its image and its record.

An image takes its light from the path tracer, its smooth edges from geometry (`antialias`), and what is behind from a
formula, a photograph or a look-up in a sky. The tracer renders only the box around the objects, and of that only the
pixels that show an object are used. The box therefore leaves no seam that could reveal where the objects are.
"""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phd_exp.records.assets import Asset
from phd_exp.records.dataset import image_name, sha256
from phd_exp.records.scenes import Backdrop, SampleRecord, Scene, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.antialias import REACH, coverage, smoothed
from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.objects import sample_object_scene
from phd_exp.rendering.pixels import Box, Light, Pixels, encode, encoded
from phd_exp.rendering.rays import (
    FACES,
    NOTHING,
    Hits,
    Mask,
    beyond_edges,
    in_camera_frame,
    trace_pixels,
    truncation,
    visibility,
)
from phd_exp.rendering.sampling import sample_scene
from phd_exp.rendering.surroundings import photo_light, shaken
from phd_exp.rendering.triangles import Meshes

GREY = 128  # of all colours beyond the edges of the user's image, as in the views of photographs
METAL_SIDE = 150  # px: smaller boxes of metal have more points in each pixel, since highlights have few pixels
FINEST = 4  # largest number of points along a side of a pixel
SOLID = 0.5  # share of a pixel from which its own light is that of the surface
LEAST_SHARE = 1e-9  # larger than rounding errors of a mean
MARGIN = 4  # px around the objects: the denoiser is less accurate along the border of its image


def fast_settings(spec: DatasetSpec) -> Settings:
    """Settings of the tracer for the images of a data set."""
    return Settings(spec.samples_per_pixel, denoised=True, points=1 if spec.mesh is None else None)


def make_sample(renderer: Renderer, spec: DatasetSpec, split: Split, index: int) -> tuple[bytes, SampleRecord]:
    """The image file and the record of one sample."""
    meshes = renderer.meshes
    scene = sample_object_scene(spec, split, index, meshes) if meshes else sample_scene(spec, split, index)
    hits = trace_pixels(scene, meshes)
    picture = photograph(renderer, scene, hits, spec) if meshes else take_picture(renderer, scene, hits)
    image = encode(picture, spec)
    return image, describe(spec, split, index, scene, hits, sha256(image), meshes)


def describe(
    spec: DatasetSpec, split: Split, index: int, scene: Scene, hits: Hits, checksum: str, meshes: Meshes
) -> SampleRecord:
    """The record of a sample, given the scene, what the rays of its pixels hit, and the image's checksum."""
    number, view = divmod(index, spec.views)
    cylinder = scene.objects[0]
    position = in_camera_frame(np.array(cylinder.position), scene.pose).tolist()
    return SampleRecord(
        **{key: getattr(scene, key) for key in Scene.model_fields},
        **dict(zip("xyz", position, strict=True)),
        file_name=image_name(index, spec.image_format),
        scale=cylinder.scale,
        visibility=visibility(hits),
        truncation=truncation(scene, hits, meshes),
        index=index,
        split=split,
        seed=spec.seed,
        scene=number,
        view=view,
        track=str(number // spec.frames) if spec.frames > 1 else None,
        time=number % spec.frames / spec.frame_rate if spec.frames > 1 else None,
        sha256=checksum,
    )


def take_picture(renderer: Renderer, scene: Scene, hits: Hits) -> Pixels:
    """Image (S, S, 3) of a scene, given what the rays of its pixels hit; sRGB, rows from the top."""
    light = backdrop_light(scene.backdrop, scene.S)
    first = hits.first
    shown = first != NOTHING
    if not shown.any():
        return encoded(light)
    box = box_around(shown, MARGIN)
    inside = box.slices
    light[inside] = np.where(shown[inside][..., None], renderer.render(scene, box), light[inside])
    return encoded(smoothed(light, first, scene))


def photograph(renderer: Renderer, scene: Scene, hits: Hits, spec: DatasetSpec) -> Pixels:
    """Image (S, S, 3) of a scene with a mesh, given what the rays of its pixels hit."""
    around, shown = scene.surroundings, hits.first != NOTHING
    assert around is not None
    light = light_behind(renderer, scene, spec)
    if around.ground is not None and not spec.empty:
        light *= 1 - shadow(renderer, scene)
    if shown.any() and not spec.empty:
        box = box_around(shown, MARGIN)
        inside = box.slices
        front, opacity = np.split(front_light(renderer, scene, hits)[inside], [3], axis=-1)
        if renderer.is_opaque:  # its edges are those of more points than its light
            covered = coverage(scene, box, renderer.meshes)
            front, opacity = unmixed(front, opacity) * covered, covered
        light[inside] = front + (1 - opacity) * light[inside]
    picture = encoded(shaken(light, around.shake))
    picture[beyond_edges(scene)] = GREY
    return picture


def front_light(renderer: Renderer, scene: Scene, hits: Hits) -> Light:
    """Light and opacity (S, S, 4) of the objects of a scene with a mesh, traced in the box of each object."""
    shown, number = hits.first != NOTHING, (hits.first - 1) // FACES
    light = np.zeros((scene.S, scene.S, 4))
    for item, metal in enumerate(renderer.shows_metal(scene)):
        part = shown & (number == item)
        if part.any():
            box = box_around(part, MARGIN)
            inside = box.slices
            near = part | ~shown & ndimage.maximum_filter(part, 2 * REACH + 1)  # the object and its smooth edge
            traced = renderer.render(scene, box, points=points_of_metal(box) if metal else None)
            light[inside] = np.where(near[inside][..., None], traced, light[inside])
    return light


def unmixed(front: Light, opacity: Light) -> Light:
    """Light (height, width, 3) of the surfaces in each pixel, given the sum over the shares of it that they cover.

    Where a few random rays found little of a surface, their sum is nearly all error. There, the light is the mean of
    the pixels within REACH that it covers for the most part; around surfaces without such pixels, of all.
    """

    def nearby(shown: NDArray[np.bool_]) -> tuple[Light, Light]:
        size = (2 * REACH + 1, 2 * REACH + 1, 1)
        light, share = (
            ndimage.uniform_filter(np.where(shown, part, 0), size, mode="constant") for part in (front, opacity)
        )
        return light / np.maximum(share, LEAST_SHARE), share

    solid = opacity >= SOLID
    (near, share), (thin, _) = nearby(solid), nearby(opacity > 0)
    own = front / np.where(solid, opacity, 1)
    return np.where(solid, own, np.where(share > LEAST_SHARE, near, thin))


def points_of_metal(box: Box) -> int | None:
    """Points along a side of each pixel of a box that shows metal; None in a large box, where Blender draws them."""
    side = math.sqrt((box.right - box.left) * (box.bottom - box.top))
    return min(math.ceil(math.sqrt(METAL_SIDE / side)), FINEST) if side < METAL_SIDE else None


def shadow(renderer: Renderer, scene: Scene) -> Light:
    """The share of its light (S, S, 1) that the ground loses to objects; it is smooth, so half the pixels will do."""
    S = math.ceil(scene.S / 2)
    coarse = scene.model_copy(update={"S": S, "f": scene.f * S / scene.S})
    opacity = renderer.render(coarse, layer="ground")[..., 3]
    place = (np.arange(scene.S) + 0.5) * S / scene.S - 0.5
    where = np.meshgrid(place, place, indexing="ij")
    return ndimage.map_coordinates(opacity, where, order=1, mode="nearest")[..., None]


def light_behind(renderer: Renderer, scene: Scene, spec: DatasetSpec) -> Light:
    """What is behind the objects of a scene with a mesh (S, S, 3), linear light."""
    around = scene.surroundings
    assert around is not None
    if around.is_sky:
        return renderer.sky(scene)
    if around.file and isinstance(spec.backdrops, Asset):
        return photo_light(spec.backdrops.path(around.file), around, scene.S)
    return backdrop_light(scene.backdrop, scene.S)


def backdrop_light(backdrop: Backdrop, side: int) -> Light:
    """The backdrop alone (S, S, 3), linear light."""
    middles = (np.arange(side) + 0.5) / side
    x, y = middles - backdrop.centre[0], middles - backdrop.centre[1]
    light = backdrop.level * (1 - backdrop.falloff * (x[None, :] ** 2 + y[:, None] ** 2))
    return np.repeat(light[..., None], 3, axis=-1)


def box_around(mask: Mask, margin: int) -> Box:
    """The smallest box around the true pixels of a mask (S, S) and a margin, clipped to the image."""
    side = mask.shape[0]
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    left, top, right, bottom = columns[0] - margin, rows[0] - margin, columns[-1] + margin, rows[-1] + margin
    return Box(*np.clip([left, top, right + 1, bottom + 1], 0, side).tolist())
