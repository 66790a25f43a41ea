"""How the learning rate changes over the steps of a run."""

import math
from collections.abc import Callable
from typing import Literal

Schedule = Literal["constant", "cosine"]


def factor(schedule: Schedule, warmup_steps: int, steps: int) -> Callable[[int], float]:
    """Step -> the learning rate over the optimizer's, of a run of so many steps.

    It rises linearly over the first `warmup_steps`, and stays or falls to zero as half a cosine wave.
    """

    def at(step: int) -> float:
        rise = min(1.0, (step + 1) / (warmup_steps + 1))
        fall = (1 + math.cos(math.pi * min(step / steps, 1.0))) / 2 if schedule == "cosine" else 1.0
        return rise * fall

    return at
