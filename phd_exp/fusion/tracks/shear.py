"""Coordinates in which motion and projections carry no information about the distance, for weighted frames.

A path at half the distance moves half as far, and its rays deviate from the predicted ones by half as many metres. A
motion model and densities of projections in metres therefore draw a path to the camera, more strongly with more
frames. This is no information: predictions are posterior densities, whose prior is uniform in the image at every
depth, and the noise of the motion is a guess. Next to the depths of all frames its effect is small, but it is large
where these have the weight of a few frames. Both are therefore taken about a given path, that of independent frames:

- The projection of a camera is that of the position which slides along its ray to the depth of the given path. With
  the ray d from the apex (the camera, without a free axis) to the given position, q changes by -kappa (t - t_about),
  kappa = (q_v d)/(t_v d), where q_v and t_v are the slopes.
- If there is one camera, at rest, so is the motion. With the depth n.v along an axis n and n.d = 1, both from the
  camera, v~ slides to v = S v~ + offset, S = I + (d - n) n^T, offset = -(d - n) n.about. Several cameras, or one that
  moves, measure the distance by the motion; then S = I.

Both are affine, so that the energy stays convex; S keeps volumes.

Source: own derivation; checked in tests/fusion/test_tracks_moments.py.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from phd_exp.fusion.tracks.frames import Frames

Array = np.ndarray
LEAST_COSINE = 0.5  # between ray and axis
AT_REST = 1e-6  # metres


def sheared(frames: Frames, about: Float[Array, "later 3"], first: Frames | None = None) -> Frames:
    """The frames, of which the last ones are taken about these positions.

    `first` is the first frame of the track, from whose camera to whose position the axis leads (default: that here).
    """
    first = frames if first is None else first
    whole, shear = frames.about.copy(), frames.shear.copy()
    whole[-len(about) :] = about
    one = frames.mask.shape[1] == 1
    if one and (abs(frames.centres[frames.mask] - first.centres[0, 0]) < AT_REST).all():
        axis = first.about[0] - first.centres[0, 0]
        shear[-len(about) :] = _along_rays(about, first.centres[0, 0], axis / np.linalg.norm(axis))
    return replace(frames, about=whole, shear=shear)


def _along_rays(
    about: Float[Array, "frames 3"], centre: Float[Array, "3"], axis: Float[Array, "3"]
) -> Float[Array, "frames 3 4"]:
    """S and offset of each frame."""
    off = about - centre
    depth = off @ axis
    is_near = depth > LEAST_COSINE * np.linalg.norm(off, axis=-1)
    slide = np.where(is_near[:, None], off / np.where(is_near, depth, 1.0)[:, None] - axis, 0.0)
    S = np.eye(3) + slide[:, :, None] * axis
    return np.concatenate([S, (-slide * (about @ axis)[:, None])[..., None]], -1)


def apart(frames: Frames) -> tuple[Float[Array, "frames cameras 3 3"], Float[Array, "frames cameras 3"]]:
    """What cameras measure of v~: the slopes, and the values at the origin."""
    rays = (frames.about[:, None] - frames.apices)[..., None]
    along = (frames.slope @ rays)[..., 0]
    kappa = along / np.where(frames.mask, along[..., 2], 1.0)[..., None]
    kappa[..., 2] = 0.0
    of_depth = frames.slope[..., 2:, :]
    slope = frames.slope - kappa[..., None] * of_depth
    at_origin = frames.at_origin + kappa * (of_depth @ frames.about[:, None, :, None])[..., 0]
    shear = frames.shear[:, None]
    return slope @ shear[..., :3], at_origin + (slope @ shear[..., 3:])[..., 0]


def unsheared(shear: Float[Array, "frames 3 4"], x: Float[Array, "frames d"]) -> Float[Array, "frames d"]:
    """Position and its derivatives, by S for all of them."""
    parts = x.reshape(len(x), -1, 3) @ shear[..., :3].swapaxes(-1, -2)
    parts[:, 0] += shear[..., 3]
    return parts.reshape(x.shape)


def unsheared_covariance(
    shear: Float[Array, "frames 3 4"], C: Float[Array, "frames d d"]
) -> Float[Array, "frames d d"]:
    """Their covariance."""
    S, n = shear[:, None, None, :, :3], C.shape[-1] // 3
    blocks = C.reshape(len(C), n, 3, n, 3).swapaxes(2, 3)
    return (S @ blocks @ S.swapaxes(-1, -2)).swapaxes(2, 3).reshape(C.shape)
