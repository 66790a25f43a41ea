"""The networks that turn an image into features: torchvision's ResNets, trained from scratch."""

from functools import partial
from typing import Literal

from torch import nn
from torchvision.models import resnet18, resnet34, resnet50

RESNETS = {18: resnet18, 34: resnet34, 50: resnet50}


def resnet(depth: Literal[18, 34, 50]) -> nn.Module:
    """A ResNet of torchvision without its last layer, every BatchNorm replaced by GroupNorm(1, C).

    It maps (batch, 3, height, width) to (batch, n_features) and says `n_features` itself.
    Source: the authors' training protocol.
    """
    network = RESNETS[depth](weights=None, norm_layer=partial(nn.GroupNorm, 1))
    n_features = network.fc.in_features
    network.fc = nn.Identity()
    network.n_features = n_features
    return network
