"""The loss of densities."""

from jaxtyping import Float
from torch import Tensor, nn

from phd_exp.distributions import Density


class NegativeLogLikelihood(nn.Module):
    """-log p(v) of each sample, in nats, of the full density in the camera frame.

    Examples:
        >>> import torch
        >>> from phd_exp.distributions import ProjectedHuber
        >>> A = 20 * torch.eye(2).expand(1, 2, 2)
        >>> prediction = ProjectedHuber(torch.zeros(1, 2), torch.tensor([4.0]), A, torch.tensor([20.0]))
        >>> NegativeLogLikelihood()(prediction, torch.tensor([[0.1, 0.0, 4.1]]))
        tensor([-1.2429])

    Source: paper, eq. "loss after basis change", with the constants that it drops: they do not change gradients, and
    make models and data sets comparable.
    """

    prediction = Density

    def forward(self, prediction: Density, xyz: Float[Tensor, "batch 3"]) -> Float[Tensor, " batch"]:
        return -prediction.log_prob(xyz)
