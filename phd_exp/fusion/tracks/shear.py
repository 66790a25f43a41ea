"""Coordinates in which the motion of an object does not tell its distance from a camera at rest.

The law of the motion is in metres, and a path twice as near moves half as far: its noise would draw every path to the
camera, the more the less the predictions tell of depth. So for a camera at rest the law holds for the position v~ to
which v slides along its ray until its depth is that of a path `about`. With the depth n.v along an axis n and the ray
d, n.d = 1, both from the camera,

    v = S v~ + offset,    S = I + (d - n) n^T,    offset = -(d - n) n.about.

This is affine, keeps volumes, and leaves v~ = v on the path `about`. Several cameras, or one that moves, measure the
distance by the motion; then S = I.

Source: own derivation; checked in tests/fusion/test_tracks_moments.py.
"""

import numpy as np
from jaxtyping import Float

Array = np.ndarray
LEAST_COSINE = 0.5  # between ray and axis
AT_REST = 1e-6  # metres


def along_rays(
    about: Float[Array, "frames 3"], centres: Float[Array, "frames cameras 3"], first: Float[Array, "3"]
) -> Float[Array, "frames 3 4"]:
    """S and offset of each frame; the axis leads from the camera to the position `first`."""
    centre = centres[:, 0]
    off = about - centre
    axis = (first - centre[0]) / np.linalg.norm(first - centre[0])
    depth = off @ axis
    is_near = depth > LEAST_COSINE * np.linalg.norm(off, axis=-1)
    slide = np.where(is_near[:, None], off / np.where(is_near, depth, 1.0)[:, None] - axis, 0.0)
    S = np.eye(3) + slide[:, :, None] * axis
    return np.concatenate([S, (-slide * (about @ axis)[:, None])[..., None]], -1)


def is_at_rest(centres: Float[Array, "frames cameras 3"]) -> bool:
    """Whether there is one camera, whose position does not change."""
    return centres.shape[1] == 1 and bool((abs(centres - centres[:1]) < AT_REST).all())


def unsheared(shear: Float[Array, "*frames 3 4"], x: Float[Array, "*frames d"]) -> Float[Array, "*frames d"]:
    """Position and its derivatives, by S for all of them."""
    parts = x.reshape(*x.shape[:-1], -1, 3) @ shear[..., :3].swapaxes(-1, -2)
    parts[..., 0, :] += shear[..., 3]
    return parts.reshape(x.shape)


def unsheared_covariance(shear: Float[Array, "*frames 3 4"], C: Float[Array, "*frames d d"]) -> Array:
    """Their covariance."""
    S = np.kron(np.eye(C.shape[-1] // 3), shear[..., :3])
    return S @ C @ S.swapaxes(-1, -2)
