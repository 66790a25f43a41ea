"""The loss of quantile regression."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from phd_exp.distributions.density import pinball
from phd_exp.distributions.quantiles import LEVELS, Quantiles


class Pinball(nn.Module):
    """The pinball loss (no unit) of each sample: the mean over quantiles, summed over v_p and log z."""

    prediction = Quantiles

    def forward(self, prediction: Quantiles, xyz: Float[Tensor, "batch 3"]) -> Float[Tensor, " batch"]:
        excess = prediction.variables(xyz)[..., None] - prediction.knots
        return pinball(excess, torch.tensor(LEVELS).to(excess)).mean(-1).sum(-1)
