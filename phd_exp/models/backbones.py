"""Networks from image to features: ResNets, trained from scratch, and any other network."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from phd_exp.models.residual import Depth, ResNet
from phd_exp.records.errors import gist


class BackboneOutput(NamedTuple):
    """The output of a backbone.

    A backbone that locates the object also returns `place`, its projected position v_p, and `log_heat`, the log
    probabilities of the cells of a grid over the image. One that segments it returns `log_odds`, those of each cell
    showing the object.
    """

    features: Float[Tensor, "batch n_features"]
    place: Float[Tensor, "batch 2"] | None = None
    log_heat: Float[Tensor, "batch rows columns"] | None = None
    log_odds: Float[Tensor, "batch rows columns"] | None = None


class Backbone(nn.Module):
    """Abstract base class: images -> features.

    Attributes:
        n_features: number of features of an image.
        locates: whether the output has a place.
        segments: whether the output has log odds.
    """

    n_features: int
    locates: bool = False
    segments: bool = False

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> BackboneOutput:
        raise NotImplementedError


class PooledFeatures(Backbone):
    """A network from images to feature vectors, or to feature maps, which are averaged over the image."""

    def __init__(self, network: nn.Module, n_features: int) -> None:
        super().__init__()
        self.network = network
        self.n_features = n_features

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> BackboneOutput:
        features = self.network(pixels)
        return BackboneOutput(features.mean((2, 3)) if features.ndim == 4 else features)


def pooled(network: nn.Module, side: int = 224, pretrained: str | None = None) -> PooledFeatures:
    """Any network as a backbone: a black image shows the number of its features.

    Args:
        network: images (batch, 3, side, side), normalised as for ImageNet -> features (batch, n_features), or feature
            maps (batch, n_features, rows, columns).
        side: side of the images, pixels.
        pretrained: file with the network's weights, as a state dict; None keeps those it has.

    Raises ValueError for any other output, or a file with other content.

    Examples:
        >>> pooled(nn.Conv2d(3, 8, 3), side=32).n_features
        8
    """
    features = of_black_images(network, side, pretrained)
    if not isinstance(features, Tensor) or features.ndim not in (2, 4) or len(features) != 2:
        given = tuple(features.shape) if isinstance(features, Tensor) else type(features).__name__
        raise ValueError(
            f"returned {given} for 2 images of {side} px; expected (2, n) or feature maps (2, n, rows, columns)"
        )
    if not features.isfinite().all():
        raise ValueError("returned features that are not finite for a black image")
    return PooledFeatures(network, features.shape[1])


def of_black_images(network: nn.Module, side: int, pretrained: str | None) -> Any:
    """What a network returns for two black images, with the weights of a file, or those it has.

    Raises ValueError for a file with other content.
    """
    if pretrained is not None:
        with reading_weights(pretrained):
            state = torch.load(pretrained, "cpu", weights_only=True)
            network.load_state_dict(state.get("state_dict", state))
    network.eval()
    with torch.no_grad():
        output = network(torch.zeros(2, 3, side, side))
    network.train()
    return output


@contextmanager
def reading_weights(file: str) -> Iterator[None]:
    """Convert the errors of reading a network's weights to a ValueError that names the file."""
    try:
        yield
    except Exception as error:  # torch raises any for another file
        reason = gist(error) or type(error).__name__
        raise ValueError(
            f"pretrained: got {file!r}; expected a file with this network's state dict ({reason})"
        ) from None


def resnet(depth: Depth) -> PooledFeatures:
    """A ResNet of torchvision without its last layer, every BatchNorm replaced by GroupNorm(1, C).

    Examples:
        >>> resnet(18).n_features
        512

    Source: the authors' training protocol.
    """
    network = ResNet(depth)
    return PooledFeatures(network, network.n_features)
