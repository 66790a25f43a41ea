"""The loss of the regression baselines."""

from jaxtyping import Float
from torch import Tensor, nn

from phd_exp.distributions import PointEstimate


class MeanAbsoluteError(nn.Module):
    """The Euclidean norm of each residual, in the coordinates in which the network regresses (no unit).

    Source: what the paper's tables call MAE.
    """

    prediction = PointEstimate

    def forward(self, prediction: PointEstimate, xyz: Float[Tensor, "batch 3"]) -> Float[Tensor, " batch"]:
        return prediction.residual(xyz).norm(dim=-1)
