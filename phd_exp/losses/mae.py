"""The loss of the regression baselines."""

from jaxtyping import Float
from torch import Tensor, nn

from phd_exp.distributions import PointEstimate


class MeanAbsoluteError(nn.Module):
    """The Euclidean norm of each residual, in the coordinates that the network regresses (no unit).

    Examples:
        >>> import torch
        >>> from phd_exp.geometry import Camera, Cartesian, DepthScale
        >>> chart = Cartesian(DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0)))
        >>> estimate = PointEstimate(torch.zeros(1, 3), chart, Camera(torch.tensor([1500.0]), 224.0))
        >>> MeanAbsoluteError()(estimate, torch.tensor([[0.0, 0.0, 4.0]]))
        tensor([0.])

    Source: what the paper's tables call MAE.
    """

    prediction = PointEstimate

    def forward(self, prediction: PointEstimate, xyz: Float[Tensor, "batch 3"]) -> Float[Tensor, " batch"]:
        return prediction.residual(xyz).norm(dim=-1)
