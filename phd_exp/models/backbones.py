"""The networks that turn an image into features: torchvision's ResNets, trained from scratch."""

from functools import partial
from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models import resnet18, resnet34, resnet50

RESNETS = {18: resnet18, 34: resnet34, 50: resnet50}


class Backbone(nn.Module):
    """An image (batch, 3, height, width) -> features (batch, n_features)."""

    def __init__(self, network: nn.Module, n_features: int) -> None:
        super().__init__()
        self.network = network
        self.n_features = n_features

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch n_features"]:
        features: Tensor = self.network(pixels)
        return features


def resnet(depth: Literal[18, 34, 50]) -> Backbone:
    """A ResNet of torchvision without its last layer, every BatchNorm replaced by GroupNorm(1, C).

    Source: the authors' training protocol.
    """
    network = RESNETS[depth](weights=None, norm_layer=partial(nn.GroupNorm, 1))
    n_features = network.fc.in_features
    network.fc = nn.Identity()
    return Backbone(network, n_features)
