"""The loss of the probabilistic model."""

from jaxtyping import Float
from torch import Tensor, nn

from phd_exp.distributions import ProjectedHuber


class NegativeLogLikelihood(nn.Module):
    """-log p(v) of each sample, in nats, of the full density in the camera frame.

    Source: paper, eq. "loss after basis change"; the constants it drops are kept here, so that models and
    data sets compare. They do not move gradients.
    """

    prediction = ProjectedHuber

    def forward(self, prediction: ProjectedHuber, xyz: Float[Tensor, "batch 3"]) -> Float[Tensor, " batch"]:
        return -prediction.log_prob(xyz)
