"""As `phd_exp.fusion.energy`."""

import math
from typing import no_type_check

import numpy as np

from phd_exp.fusion.compiled import compiled


@compiled
@no_type_check
def huber(squared):
    """h(|q|) of |q|^2."""
    return math.sqrt(squared) - 0.5 if squared > 1 else squared / 2


@compiled
@no_type_check
def extended_inverse(t, least):
    """1/t and its first two derivatives, continued below t = least."""
    inverse = 1 / max(t, least)
    short = min(t - least, 0.0) / least
    return inverse * (1 - short + short * short), inverse * inverse * (2 * short - 1), 2 * inverse**3


@compiled
@no_type_check
def energy(q_x, q_y, t, a):
    """h(|q|) + a max(t, 1/t) of one camera; infinite for t <= 0."""
    if a == 0:
        return huber(q_x * q_x + q_y * q_y)
    return huber(q_x * q_x + q_y * q_y) + a * max(t, 1 / t) if t > 0 else np.inf
