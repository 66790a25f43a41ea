"""Backbones that locate the object: a narrow ResNet or any other network, a feature pyramid, and a heat map."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import torch
from annotated_types import Ge, Gt, MultipleOf
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import interpolate, relu

from phd_exp.geometry.camera import middles
from phd_exp.models.backbones import Backbone, BackboneOutput, of_black_images
from phd_exp.models.residual import BLOCKS, NORM, Depth, convolution, initialise, residual_stage


class Pyramid(Backbone):
    """Abstract base class: feature maps -> a map of the object, and features read at the object.

    The feature maps, each coarser than the one before, are combined at the resolution of the first. A map over this
    level of the pyramid holds for each cell the probability that it contains the object's centre, and the offset of
    the centre from that of the cell; `place` is the mean position. The features are those of the level, averaged with
    the same probabilities, and the mean of the last feature map.

    With `segments`, the map also holds the probability that each cell shows the object. The features then include
    those of the level averaged with these probabilities too, and the area, centre and shape of the visible part.

    With `points`, the network also finds that many points, which it chooses itself, without labels. A further map
    for each point holds the probability of each cell. The mean of the map, relative to `place`, and its log variance
    are features, from which the hidden layers of a `Regressor` can learn distances on the object.

    The map and its means are computed in float32: bfloat16 would round places to a tenth of a pixel.

    Source: Lin et al., "Feature pyramid networks for object detection" (2017); the mean over a map, Sun et al.,
    "Integral human pose regression" (2018); points without supervision, Levine et al., "End-to-end training of deep
    visuomotor policies" (2016).
    """

    locates = True

    def feature_maps(self, pixels: Float[Tensor, "batch 3 height width"]) -> list[Float[Tensor, "batch _ _ _"]]:
        """Feature maps, finest first."""
        raise NotImplementedError

    def _read_with(self, counts: list[int], channels: int, segments: bool, points: int) -> None:
        """Make the layers that read feature maps with these numbers of channels; a subclass calls it once."""
        self.lateral = nn.ModuleList(nn.Conv2d(n, channels, 1) for n in counts)
        self.smooth = nn.Conv2d(channels, channels, 3, padding=1)
        self.map = nn.Conv2d(channels, 4 if segments else 3, 1)
        # a uniform map: the place is the centre of the image, as for a network whose last layer is zero
        nn.init.zeros_(self.map.weight)
        nn.init.zeros_(self.map.bias)  # type: ignore[arg-type]  # it has one
        self.segments = segments
        self.points = nn.Conv2d(channels, points, 1) if points else None
        self.n_features = channels + counts[-1] + (channels + 6 if segments else 0) + 3 * points

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> BackboneOutput:
        maps = self.feature_maps(pixels)
        finest = self._finest(maps)
        with torch.autocast(pixels.device.type, enabled=False):
            return self._read(finest.float(), maps[-1].float())

    def _finest(self, maps: list[Tensor]) -> Float[Tensor, "batch channels rows columns"]:
        """The finest level of the pyramid, with the upsampled coarser levels added."""
        levels = [lateral(features) for lateral, features in zip(self.lateral, maps, strict=True)]
        finest = levels[-1]
        for finer in reversed(levels[:-1]):
            finest = finer + interpolate(finest, size=finer.shape[-2:], mode="nearest")
        return relu(self.smooth(relu(finest)))

    def _read(self, finest: Tensor, last: Tensor) -> BackboneOutput:
        score, offset, log_odds = self.map(finest).split([1, 2, int(self.segments)], dim=1)
        cells = middles(*score.shape[-2:]).movedim(-1, 0).to(score)
        log_heat = score.flatten(1).log_softmax(-1)
        weight = log_heat.exp()[:, None]
        features = [(weight * finest.flatten(2)).sum(-1), last.mean((2, 3))]
        if self.segments:
            features += _of_segment(log_odds.sigmoid().flatten(1), finest.flatten(2), cells.flatten(1))
        place = (weight * (cells + offset).flatten(2)).sum(-1)
        if self.points is not None:
            features.append(_of_points(self.points(finest).flatten(2).softmax(-1), cells.flatten(1), place))
        return BackboneOutput(
            features=torch.cat(features, dim=-1),
            place=place,
            log_heat=log_heat.unflatten(-1, score.shape[-2:]),
            log_odds=log_odds[:, 0] if self.segments else None,
        )


class Locating(Pyramid):
    """A ResNet with a pyramid over all its stages but the first.

    It has `width` channels instead of torchvision's 64, and no max-pooling: half the channels on four times the
    pixels cost the same and double the resolution. Large images with stride 4 cost little more than images of half
    the size with stride 2, and have sharper edges.

    Args:
        depth: of the ResNet.
        width: channels of its first stage. At 12, torch's convolutions write beyond their memory on some CPUs.
        stride: of the first convolution.
        channels: of the pyramid.
        segments: whether the map holds the visible part of the object.
        points: number of points that the network chooses.
    """

    def __init__(
        self,
        depth: Depth,
        width: Annotated[int, Gt(0), MultipleOf(8)],
        stride: Literal[2, 4],
        channels: Annotated[int, Ge(1)],
        segments: bool = False,
        points: Annotated[int, Ge(0)] = 0,
    ) -> None:
        super().__init__()
        block, counts = BLOCKS[depth]
        widths = [width * 2**stage for stage in range(len(counts))]
        outputs = [n * block.expansion for n in widths]
        self.stem = nn.Sequential(convolution(3, width, 7, stride), NORM(width), nn.ReLU(inplace=True))
        self.stages = nn.ModuleList(
            residual_stage(block, count, n_in, n, stride=1 if n == width else 2)
            for count, n_in, n in zip(counts, [width, *outputs], widths, strict=False)
        )
        initialise(self)
        self._read_with(outputs[1:], channels, segments, points)

    def feature_maps(self, pixels: Float[Tensor, "batch 3 height width"]) -> list[Float[Tensor, "batch _ _ _"]]:
        """The outputs of all stages but the first."""
        maps = [self.stem(pixels)]
        for stage in self.stages:
            maps.append(stage(maps[-1]))
        return maps[2:]


class LocatingNetwork(Pyramid):
    """Any network that returns feature maps, such as those of timm with `features_only=True`, with a pyramid.

    Args:
        network: images (batch, 3, side, side), normalised as for ImageNet -> list or dictionary of feature maps
            (batch, n, rows, columns), each coarser than the one before.
        channels: of the pyramid.
        side: side of the images, px.
        segments: whether the map holds the visible part of the object.
        points: number of points that the network chooses.
        pretrained: file with the network's weights, as a state dict; None keeps those it has.

    Raises:
        ValueError: any other output, or a file with other content.
    """

    def __init__(
        self,
        network: nn.Module,
        channels: Annotated[int, Ge(1)],
        side: int = 224,
        segments: bool = True,
        points: Annotated[int, Ge(0)] = 0,
        pretrained: str | None = None,
    ) -> None:
        super().__init__()
        self.network = network
        shapes = [tuple(getattr(m, "shape", ())) for m in _listed(of_black_images(network, side, pretrained))]
        rows = [shape[-2] for shape in shapes if len(shape) == 4]
        if not rows or rows != sorted(set(rows), reverse=True) or len(rows) < len(shapes):
            raise ValueError(
                f"returned {shapes} for 2 images of {side} px; expected feature maps (2, n, rows, columns), each "
                "coarser than the one before"
            )
        self._read_with([shape[1] for shape in shapes], channels, segments, points)

    def feature_maps(self, pixels: Float[Tensor, "batch 3 height width"]) -> list[Float[Tensor, "batch _ _ _"]]:
        """Those of the network."""
        return _listed(self.network(pixels))


def _listed(maps: Any) -> list[Any]:
    """The feature maps that a network returns as a list, or by name, as torchvision's feature extractors do."""
    return list(maps.values() if isinstance(maps, Mapping) else maps)


def _of_segment(
    probability: Float[Tensor, "batch cells"],
    level: Float[Tensor, "batch channels cells"],
    cells: Float[Tensor, "2 cells"],
) -> list[Tensor]:
    """Means of a level over a region, and the region's log area, centre, and covariance over that of a disk.

    The disk has the same area, so that all numbers are of the order of one.
    """
    area = 4 * probability.mean(-1, keepdim=True) + 1e-4  # in units in which the image reaches from -1 to 1
    weight = probability / probability.sum(-1, keepdim=True).clamp_min(1e-4)
    centre = weight @ cells.T
    x, y = (cells - centre[:, :, None]).unbind(1)
    covariance = torch.stack([(weight * product).sum(-1) for product in (x * x, x * y, y * y)], dim=-1)
    return [(weight[:, None] * level).sum(-1), area.log(), centre, 4 * math.pi * covariance / area]


def _of_points(
    probability: Float[Tensor, "batch points cells"], cells: Float[Tensor, "2 cells"], place: Float[Tensor, "batch 2"]
) -> Float[Tensor, "batch features"]:
    """The mean places of points relative to the object's, and the log variances of their maps."""
    mean = probability @ cells.T
    variance = probability @ cells.square().sum(0) - mean.square().sum(-1)
    return torch.cat([(mean - place[:, None]).flatten(1), variance.clamp_min(1e-4).log()], dim=-1)
