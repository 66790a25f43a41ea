"""The unknowns of a path: position (relative to an origin, metres), velocity, and acceleration if there is one."""

import numpy as np
from jaxtyping import Float

from phd_exp.fusion.tracks.motion import Motion, transitions

Array = np.ndarray
VELOCITY = slice(3, 6)
"""Where the unknowns of a frame have the velocity."""


def start(motion: Motion) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Mean and precision of the first frame's unknowns before any prediction; the position is not known."""
    precision = np.concatenate([np.zeros(3), np.repeat(np.array(motion.deviations) ** -2.0, 3)])
    return np.zeros(len(precision)), np.diag(precision)


def moving(
    motion: Motion, steps: Float[Array, " steps"]
) -> tuple[Float[Array, "steps d d"], Float[Array, "steps d d"]]:
    """The transitions and the precisions of their noise over these times (seconds)."""
    F, W = transitions(motion, steps)
    return in_space(F), in_space(W)


def in_space(M: Float[Array, "*batch m n"]) -> Float[Array, "*batch d e"]:
    """The matrix that does the same in each of the three axes: its Kronecker product with I."""
    m, n = M.shape[-2:]
    spread = M[..., :, None, :, None] * np.eye(3)[:, None]
    found: Array = spread.reshape(*M.shape[:-2], 3 * m, 3 * n)
    return found
