"""How the weights of a network follow the gradient: the optimizer and the schedule of its learning rate."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import nn
from torch.optim.lr_scheduler import LambdaLR


@dataclass(frozen=True)
class Optimisation:
    """Parameters -> optimizer, whose learning rate follows a schedule.

    Attributes:
        optimizer: parameters -> optimizer.
        schedule: number of steps -> factor of the learning rate at each; see `factor`. Constant by default.
    """

    optimizer: Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer] = torch.optim.Adam
    schedule: Callable[[int], Callable[[int], float]] = lambda steps: lambda step: 1.0

    def __call__(self, parameters: Iterable[nn.Parameter], steps: int) -> OptimizerLRScheduler:
        optimizer = self.optimizer(parameters)
        scheduler = LambdaLR(optimizer, self.schedule(steps))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}


def factor(schedule: str, warmup_steps: int, steps: int) -> Callable[[int], float]:
    """Step -> factor of the optimizer's learning rate, in a run of `steps` steps.

    It rises linearly over the first `warmup_steps`. Then "constant" stays; "cosine" falls to zero as half a wave.

    Examples:
        >>> at = factor("cosine", warmup_steps=1, steps=100)
        >>> [round(at(step), 3) for step in (0, 50, 100)]
        [0.5, 0.5, 0.0]
    """

    def at(step: int) -> float:
        rise = min(1.0, (step + 1) / (warmup_steps + 1))
        fall = (1 + math.cos(math.pi * min(step / steps, 1.0))) / 2 if schedule == "cosine" else 1.0
        return rise * fall

    return at
