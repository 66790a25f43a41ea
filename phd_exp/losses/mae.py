"""The loss of the regression baselines."""

from jaxtyping import Float
from torch import Tensor, nn

from phd_exp.distributions import PointEstimate


class MeanAbsoluteError(nn.Module):
    """The mean Euclidean norm of the residual in the coordinates in which the network regresses (no unit).

    Source: what the paper's tables call MAE.
    """

    prediction = PointEstimate

    def forward(self, prediction: PointEstimate, xyz: Float[Tensor, "batch 3"]) -> Float[Tensor, ""]:
        return prediction.residual(xyz).norm(dim=-1).mean()
