"""The focal length as an input of the network, so that it can learn the range of depths in its data set."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from phd_exp.geometry.charts import DepthScale

WIDTH = 64


class FocalLengthInput(nn.Module):
    """Corrects a head's raw numbers given the focal length; the identity at the start of training.

    An image alone shows v_p and z/f. If objects differ in size, it shows z/f only within a factor, part of which the
    range of depths rules out: if all objects are between 3 and 5 m, one that appears to be at 6 m is larger than it
    appears. A network can learn that only if f is an input. It then assumes that objects are where those of its
    training data were; for use elsewhere, train with camera=known.

    Two hidden layers take the raw numbers and log f, clamped to the range of the data set: nothing is extrapolated.

    Args:
        n_outputs: raw numbers of the head.
        depth: constants of the data set.
    """

    def __init__(self, n_outputs: int, depth: DepthScale) -> None:
        super().__init__()
        self.middle = math.log(depth.z_centre / depth.mu_z0)
        self.half_range = max(math.log(depth.D), 1e-3)
        self.layers = nn.Sequential(
            nn.Linear(n_outputs + 1, WIDTH), nn.GELU(), nn.Linear(WIDTH, WIDTH), nn.GELU()
        )
        self.last = nn.Linear(WIDTH, n_outputs)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(
        self, raw: Float[Tensor, "batch n_outputs"], f: Float[Tensor, " batch"]
    ) -> Float[Tensor, "batch n_outputs"]:
        log_f = ((f.log() - self.middle) / self.half_range).clamp(-1, 1)
        shown: Tensor = self.last(self.layers(torch.cat([raw, log_f.to(raw)[:, None]], dim=-1)))
        return raw + shown
