"""The network: image and camera in, prediction out."""

import math

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from phd_exp.geometry.camera import Camera
from phd_exp.geometry.charts import DepthScale
from phd_exp.models.backbones import Backbone, BackboneOutput
from phd_exp.models.heads import Head, Prediction

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
WIDTH = 64  # of the hidden layers that take the focal length


def _hidden_layers(n_inputs: int, units: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_inputs, units), nn.GELU(), nn.Linear(units, units), nn.GELU())


class FocalLengthInput(nn.Module):
    """Corrects a head's raw numbers given the focal length; the identity at the start of training.

    An image determines v_p and z/f only. If the sizes of objects vary, it determines z/f up to a factor, and the
    range of depths excludes part of that factor: if all objects are between 3 and 5 m, one that appears to be at 6 m
    is a large one. A network can learn this only if f is an input. It then relies on the range of depths of its
    training data; for other ranges train with camera=known.

    Two hidden layers take the raw numbers and log f, clamped to the range of the data set to avoid extrapolation.

    Args:
        n_outputs: raw numbers of the head.
        depth: constants of the data set.
    """

    def __init__(self, n_outputs: int, depth: DepthScale) -> None:
        super().__init__()
        self.middle = math.log(depth.z_centre / depth.mu_z0)
        self.half_range = max(math.log(depth.D), 1e-3)
        self.layers = _hidden_layers(n_outputs + 1, WIDTH)
        self.last = nn.Linear(WIDTH, n_outputs)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(
        self, raw: Float[Tensor, "batch n_outputs"], f: Float[Tensor, " batch"]
    ) -> Float[Tensor, "batch n_outputs"]:
        log_f = ((f.log() - self.middle) / self.half_range).clamp(-1, 1)
        shown: Tensor = self.last(self.layers(torch.cat([raw, log_f.to(raw)[:, None]], dim=-1)))
        return raw + shown


class Regressor(nn.Module):
    """backbone -> hidden layers, if any -> linear layer, zero at the start -> correction by the focal length, if f is
    an input -> head.

    The linear layer reads the features and the outputs of the hidden layers: how large an object appears depends on
    its orientation in ways that are not linear.

    The backbone runs in the precision of the enclosing autocast; all that follows runs in float32, since nu_p = B v_p
    rounded to bfloat16 has errors up to 0.2 pixels at the border of the image.
    Images keep their memory format, channels last, which is at least as fast on CPUs.

    Args:
        backbone: images -> features, and the object's place if it locates the object.
        head: raw numbers -> prediction.
        shown: the correction by the focal length; None: it is no input.
        exposure: multiply each channel of each image by the factor that makes its mean that of ImageNet, so that
            predictions do not depend on brightness and white balance.
        hidden: units of each of two hidden layers; 0 for none.

    Examples:
        >>> import torch
        >>> from phd_exp.geometry import Camera, DepthScale
        >>> from phd_exp.models.backbones import resnet
        >>> from phd_exp.models.heads import DistributionHead
        >>> depth = DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0))
        >>> regressor = Regressor(resnet(10), DistributionHead(depth))
        >>> image = torch.zeros(2, 64, 64, 3, dtype=torch.uint8)
        >>> regressor(image, Camera(torch.tensor([1200.0, 2000.0]), 224.0))
        ProjectedHuber(batch_shape=(2,))
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        backbone: Backbone,
        head: Head,
        shown: FocalLengthInput | None = None,
        exposure: bool = False,
        hidden: int = 0,
    ) -> None:
        super().__init__()
        self.backbone = backbone.to(memory_format=torch.channels_last)
        self.head = head
        n = backbone.n_features
        self.hidden = nn.Sequential(nn.LayerNorm(n), *_hidden_layers(n, hidden)) if hidden else None
        self.last = nn.Linear(n + hidden, head.n_outputs)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.shown = shown
        self.exposure = exposure
        for name, values in (("mean", IMAGENET_MEAN), ("std", IMAGENET_STD)):
            # multiplied by numpy: without memory, torch would import its compiler to multiply
            self.register_buffer(name, torch.tensor(255 * np.array(values, np.float32)), persistent=False)

    def forward(self, image: UInt8[Tensor, "batch height width 3"], camera: Camera) -> Prediction:
        return self.prediction(self.see(image), camera)

    def prediction(self, output: BackboneOutput, camera: Camera) -> Prediction:
        """The prediction, given the output of the backbone."""
        return self.head(self.numbers(output, camera.f), camera)

    def trained(self, output: BackboneOutput, camera: Camera) -> tuple[Prediction, Prediction]:
        """The prediction, and the one whose loss training minimises.

        They are the same, unless the head has a surrogate; the prediction is then without gradients.
        """
        numbers = self.numbers(output, camera.f)
        surrogate = getattr(self.head, "surrogate", None)
        if surrogate is None:
            prediction = self.head(numbers, camera)
            return prediction, prediction
        return self.head(numbers.detach(), camera), surrogate(numbers, camera)

    def raw(
        self, image: UInt8[Tensor, "batch height width 3"], f: Float[Tensor, " batch"] | None = None
    ) -> Float[Tensor, "batch n_outputs"]:
        """The raw numbers for the head, in the precision of the last layer; f (px) is needed if it is an input."""
        return self.numbers(self.see(image), f)

    def see(
        self, image: UInt8[Tensor, "batch height width 3"] | Float[Tensor, "batch height width 3"]
    ) -> BackboneOutput:
        """The output of the backbone."""
        width = image.shape[2]
        # row by row: four times faster than three colours at a time, which do not fill vector units
        rows = image.flatten(2).to(self.mean.dtype)
        if self.exposure:
            # a quarter of the rows gives nearly the same mean in a quarter of the time
            mean = rows[:, ::4].mean(1).unflatten(1, (width, 3)).mean(1).clamp_min(1)
            rows = rows.mul_((self.mean / mean).repeat(1, width).unsqueeze(1))
        rows = rows.sub_(self.mean.repeat(width)).div_(self.std.repeat(width))
        output: BackboneOutput = self.backbone(rows.unflatten(2, (width, 3)).permute(0, 3, 1, 2))
        return output

    def numbers(self, output: BackboneOutput, f: Float[Tensor, " batch"] | None) -> Float[Tensor, "batch n_outputs"]:
        """The raw numbers for the head, given the output of the backbone, and f if it is an input."""
        dtype = self.last.weight.dtype
        with torch.autocast(output.features.device.type, enabled=False):
            features = output.features.to(dtype)
            if self.hidden is not None:
                features = torch.cat([features, self.hidden(features)], dim=-1)
            raw: Tensor = self.last(features)
            if self.shown is not None:
                raw = self.shown(raw, f)
            return raw if output.place is None else self.head.placed(raw, output.place.to(dtype))
