"""The whole network: image and camera in, prediction out."""

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from phd_exp.geometry.camera import Camera
from phd_exp.models.backbones import Backbone, BackboneOutput
from phd_exp.models.focal_length import FocalLengthInput
from phd_exp.models.heads import Head, Prediction

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class Regressor(nn.Module):
    """backbone -> one linear layer, zero at the start -> what the focal length adds, if it is shown -> head.

    The backbone runs in whatever precision is switched on around it; the linear layer and everything after it
    in float32, since nu_p = B v_p rounded to bf16 would be wrong by up to 0.2 pixels at the border of the image.
    Images lie in memory as they come, channels last: on CPUs and GPUs convolutions are as fast that way, or faster.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, backbone: Backbone, head: Head, shown: FocalLengthInput | None = None) -> None:
        super().__init__()
        self.backbone = backbone.to(memory_format=torch.channels_last)
        self.head = head
        self.last = nn.Linear(backbone.n_features, head.n_outputs)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.shown = shown
        self.register_buffer("mean", 255 * torch.tensor(IMAGENET_MEAN), persistent=False)
        self.register_buffer("std", 255 * torch.tensor(IMAGENET_STD), persistent=False)

    def forward(self, image: UInt8[Tensor, "batch height width 3"], camera: Camera) -> Prediction:
        return self.prediction(self.see(image), camera)

    def prediction(self, seen: BackboneOutput, camera: Camera) -> Prediction:
        """What follows from what was seen."""
        return self.head(self.numbers(seen, camera.f), camera)

    def raw(
        self, image: UInt8[Tensor, "batch height width 3"], f: Float[Tensor, " batch"] | None = None
    ) -> Float[Tensor, "batch n_outputs"]:
        """The numbers before the head, in the precision of the last layer; f (px) is wanted where it is shown."""
        return self.numbers(self.see(image), f)

    def see(self, image: UInt8[Tensor, "batch height width 3"]) -> BackboneOutput:
        """What the backbone makes of the images."""
        width = image.shape[2]
        # by whole rows, which fill vector units where the three colours of a pixel do not: four times faster
        rows = image.flatten(2).to(self.mean.dtype).sub_(self.mean.repeat(width)).div_(self.std.repeat(width))
        seen: BackboneOutput = self.backbone(rows.unflatten(2, (width, 3)).permute(0, 3, 1, 2))
        return seen

    def numbers(
        self, seen: BackboneOutput, f: Float[Tensor, " batch"] | None
    ) -> Float[Tensor, "batch n_outputs"]:
        """The numbers before the head, of what was seen, and of f where it is shown."""
        dtype = self.last.weight.dtype
        with torch.autocast(seen.features.device.type, enabled=False):
            raw: Tensor = self.last(seen.features.to(dtype))
            if self.shown is not None:
                raw = self.shown(raw, f)
            return raw if seen.place is None else self.head.placed(raw, seen.place.to(dtype))
