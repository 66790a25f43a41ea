"""The networks that turn an image into features: torchvision's ResNets, trained from scratch."""

from functools import partial
from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models.resnet import BasicBlock, Bottleneck, ResNet

BLOCKS: dict[int, tuple[type[BasicBlock | Bottleneck], list[int]]] = {
    10: (BasicBlock, [1, 1, 1, 1]),
    18: (BasicBlock, [2, 2, 2, 2]),
    34: (BasicBlock, [3, 4, 6, 3]),
    50: (Bottleneck, [3, 4, 6, 3]),
}
"""Depth -> kind of block, and how many of them at each of the four resolutions."""


class Backbone(nn.Module):
    """An image (batch, 3, height, width) -> features (batch, n_features)."""

    def __init__(self, network: nn.Module, n_features: int) -> None:
        super().__init__()
        self.network = network
        self.n_features = n_features

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch n_features"]:
        features: Tensor = self.network(pixels)
        return features


def resnet(depth: Literal[10, 18, 34, 50]) -> Backbone:
    """A ResNet of torchvision without its last layer, every BatchNorm replaced by GroupNorm(1, C).

    Source: the authors' training protocol.
    """
    network = ResNet(*BLOCKS[depth], norm_layer=partial(nn.GroupNorm, 1))
    n_features = network.fc.in_features
    network.fc = nn.Identity()
    return Backbone(network, n_features)
