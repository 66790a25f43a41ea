"""ResNets with GroupNorm(1, C). Names, initial weights and results are those of torchvision's.

They are written out because importing torchvision takes a tenth of the time that a prediction of one image takes.

Source: He et al., "Deep residual learning for image recognition" (2016); torchvision's variant has the stride of a
bottleneck in its 3 x 3 convolution. Checked against torchvision in tests/models/test_regressor.py.
"""

from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d

Depth = Literal[10, 18, 34, 50]
NORM = partial(nn.GroupNorm, 1)  # in place of every BatchNorm


def convolution(n_in: int, n_out: int, size: int, stride: int = 1) -> nn.Conv2d:
    """A convolution without bias that divides the resolution by its stride."""
    return nn.Conv2d(n_in, n_out, size, stride, padding=size // 2, bias=False)


class BasicBlock(nn.Module):
    """Two convolutions of `width` channels, added to the input, or to its `shortcut` where the shape changes."""

    expansion = 1

    def __init__(self, n_in: int, width: int, stride: int = 1, shortcut: nn.Module | None = None) -> None:
        super().__init__()
        self.conv1 = convolution(n_in, width, 3, stride)
        self.bn1 = NORM(width)
        self.conv2 = convolution(width, width, 3)
        self.bn2 = NORM(width)
        self.downsample = nn.Identity() if shortcut is None else shortcut

    def forward(self, x: Float[Tensor, "batch n_in rows columns"]) -> Float[Tensor, "batch n_out _ _"]:
        out = torch.relu_(self.bn1(self.conv1(x)))
        return torch.relu_(self.bn2(self.conv2(out)).add_(self.downsample(x)))


class Bottleneck(nn.Module):
    """The same with three convolutions, the last of which has four times `width` channels."""

    expansion = 4

    def __init__(self, n_in: int, width: int, stride: int = 1, shortcut: nn.Module | None = None) -> None:
        super().__init__()
        self.conv1 = convolution(n_in, width, 1)
        self.bn1 = NORM(width)
        self.conv2 = convolution(width, width, 3, stride)
        self.bn2 = NORM(width)
        self.conv3 = convolution(width, self.expansion * width, 1)
        self.bn3 = NORM(self.expansion * width)
        self.downsample = nn.Identity() if shortcut is None else shortcut

    def forward(self, x: Float[Tensor, "batch n_in rows columns"]) -> Float[Tensor, "batch n_out _ _"]:
        out = torch.relu_(self.bn1(self.conv1(x)))
        out = torch.relu_(self.bn2(self.conv2(out)))
        return torch.relu_(self.bn3(self.conv3(out)).add_(self.downsample(x)))


BLOCKS: dict[int, tuple[type[BasicBlock | Bottleneck], list[int]]] = {
    10: (BasicBlock, [1, 1, 1, 1]),
    18: (BasicBlock, [2, 2, 2, 2]),
    34: (BasicBlock, [3, 4, 6, 3]),
    50: (Bottleneck, [3, 4, 6, 3]),
}
"""Depth -> type of block, and the number of blocks at each of the four resolutions."""


def residual_stage(
    block: type[BasicBlock | Bottleneck], count: int, n_in: int, width: int, stride: int
) -> nn.Sequential:
    """`count` blocks, the first of which changes resolution and channels."""
    n_out = width * block.expansion
    shortcut = None
    if stride > 1 or n_in != n_out:
        shortcut = nn.Sequential(convolution(n_in, n_out, 1, stride), NORM(n_out))
    first = block(n_in, width, stride, shortcut)
    return nn.Sequential(first, *(block(n_out, width) for _ in range(count - 1)))


def initialise(network: nn.Module) -> None:
    """Draw the weights of all convolutions anew, by the rule of torchvision's ResNets."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")


class ResNet(nn.Module):
    """The convolutions of a ResNet of 64, 128, 256 and 512 channels: images -> features, means over the image."""

    def __init__(self, depth: Depth) -> None:
        super().__init__()
        block, counts = BLOCKS[depth]
        self.conv1 = convolution(3, 64, 7, 2)
        self.bn1 = NORM(64)
        self.maxpool = nn.MaxPool2d(3, 2, padding=1)
        widths, n = (64, 128, 256, 512), block.expansion
        inputs = (64, *(n * width for width in widths))
        for index, (count, n_in, width) in enumerate(zip(counts, inputs, widths, strict=False)):
            layer = residual_stage(block, count, n_in, width, stride=1 if index == 0 else 2)
            self.add_module(f"layer{index + 1}", layer)
        self.n_features = n * widths[-1]
        nn.Linear(self.n_features, 1000)  # torchvision's last layer: with its draws, a seed makes the same network
        initialise(self)

    def forward(self, x: Float[Tensor, "batch 3 rows columns"]) -> Float[Tensor, "batch n_features"]:
        x = self.maxpool(torch.relu_(self.bn1(self.conv1(x))))
        for index in range(4):
            x = self.get_submodule(f"layer{index + 1}")(x)
        return adaptive_avg_pool2d(x, 1).flatten(1)
