"""What the focal length adds to what an image says: which depths objects are at, whatever their size."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from phd_exp.geometry.charts import DepthScale

WIDTH = 64


class ShownFocalLength(nn.Module):
    """From a head's raw numbers, and the focal length, to raw numbers; the same ones at the start of training.

    An image alone shows v_p and z/f. Where objects differ in size it shows z/f within a factor only, of which much
    is ruled out by where objects are: if all are between 3 and 5 m, what seems to be at 6 m is larger than it seems.
    That a network can only learn where it is shown f. It then takes for granted that objects are where those of its
    data set were; one that is to serve elsewhere should not be shown f (camera=known).

    Two hidden layers, on the raw numbers and the logarithm of f, which is kept within log D of its middle: far from
    the focal lengths of the data set nothing was learnt, and nothing is extrapolated.

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
