"""Networks from image to features: torchvision's ResNets, trained from scratch."""

from functools import partial
from typing import Literal, NamedTuple

from jaxtyping import Float
from torch import Tensor, nn
from torchvision.models.resnet import BasicBlock, Bottleneck, ResNet

BLOCKS: dict[int, tuple[type[BasicBlock | Bottleneck], list[int]]] = {
    10: (BasicBlock, [1, 1, 1, 1]),
    18: (BasicBlock, [2, 2, 2, 2]),
    34: (BasicBlock, [3, 4, 6, 3]),
    50: (Bottleneck, [3, 4, 6, 3]),
}
"""Depth -> type of block, and the number of blocks at each of the four resolutions."""

Depth = Literal[10, 18, 34, 50]


class BackboneOutput(NamedTuple):
    """The output of a backbone.

    A backbone that locates the object also returns `place`, its projected position v_p, and `log_heat`, the log
    probabilities of the cells of a grid over the image.
    """

    features: Float[Tensor, "batch n_features"]
    place: Float[Tensor, "batch 2"] | None = None
    log_heat: Float[Tensor, "batch rows columns"] | None = None


class Backbone(nn.Module):
    """Abstract base class: images -> features.

    Attributes:
        n_features: number of features of an image.
        locates: whether the output has a place.
    """

    n_features: int
    locates: bool

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> BackboneOutput:
        raise NotImplementedError


class PooledFeatures(Backbone):
    """A network that averages its features over the image, as ResNets do."""

    locates = False

    def __init__(self, network: nn.Module, n_features: int) -> None:
        super().__init__()
        self.network = network
        self.n_features = n_features

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> BackboneOutput:
        return BackboneOutput(self.network(pixels))


def resnet(depth: Depth) -> PooledFeatures:
    """A ResNet of torchvision without its last layer, every BatchNorm replaced by GroupNorm(1, C).

    Examples:
        >>> resnet(18).n_features
        512

    Source: the authors' training protocol.
    """
    network = ResNet(*BLOCKS[depth], norm_layer=partial(nn.GroupNorm, 1))
    n_features = network.fc.in_features
    network.fc = nn.Identity()
    return PooledFeatures(network, n_features)
