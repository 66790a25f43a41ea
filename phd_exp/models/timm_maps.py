"""Feature maps of the networks of timm, with weights that were trained on photographs."""

import fnmatch
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from urllib.request import urlopen

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from phd_exp.models.backbones import reading_weights
from phd_exp.models.regressor import IMAGENET_MEAN, IMAGENET_STD
from phd_exp.records.errors import gist, unknown

WAIT = 10.0  # seconds for the first answer of a server


class TimmMaps(nn.Module):
    """A network of timm without its last layers, for `LocatingNetwork`.

    The first layers of a pretrained network have learned edges and textures from many photographs. If they
    stay as they are (`frozen`), training needs fewer renders and fewer steps.

    Images are normalised once more, as timm prescribes for this network.

    Args:
        name: of the network, one of `timm.list_models()`.
        pretrained: True downloads timm's weights. A string is a file with them, the state dict of the network with or
            without its last layers. False starts from random weights.
        frozen: names of modules whose parameters training does not change, as patterns: `*.conv_dw` for all depthwise
            convolutions, whose gradients are slow on CPUs. If there are any, the means and variances of BatchNorm
            stay too, in all layers.
        out_indices: the feature maps to return; 0 has stride 2, 1 has stride 4.

    Raises:
        ValueError: an unknown name, or a file with other content.

    Examples:
        >>> maps = TimmMaps("tf_efficientnet_lite0", frozen=["conv_stem", "blocks.0"])
        >>> [tuple(m.shape[1:]) for m in maps(torch.zeros(1, 3, 64, 64))]
        [(24, 16, 16), (40, 8, 8), (112, 4, 4), (320, 2, 2)]
    """

    scale: Tensor
    shift: Tensor

    def __init__(
        self,
        name: str,
        pretrained: bool | str = False,
        frozen: Sequence[str] = (),
        out_indices: Sequence[int] = (1, 2, 3, 4),
    ) -> None:
        super().__init__()
        import timm  # an extra
        from timm.models import load_state_dict

        # timm would download what a name such as hf-hub:USER/MODEL says
        if not timm.is_model(name):
            raise ValueError(
                unknown(name, timm.list_models(), "expected one of timm.list_models()", "unknown network")
            )
        with _downloading(name) if pretrained is True else nullcontext():
            self.network = timm.create_model(
                name, pretrained=pretrained is True, features_only=True, out_indices=tuple(out_indices)
            )
        if isinstance(pretrained, str):
            with reading_weights(pretrained):
                missing = self.network.load_state_dict(load_state_dict(pretrained), strict=False).missing_keys
                if missing:
                    raise ValueError(f"no {missing[0]}")
        _freeze(self.network, frozen)
        self.keeps_statistics = bool(frozen)
        normalised = timm.get_pretrained_cfg(name)
        std = np.array(normalised.std)
        for key, value in (
            ("scale", np.array(IMAGENET_STD) / std),
            ("shift", (np.array(IMAGENET_MEAN) - np.array(normalised.mean)) / std),
        ):
            self.register_buffer(key, torch.tensor(value, dtype=torch.float32)[:, None, None], persistent=False)

    def train(self, mode: bool = True) -> "TimmMaps":
        """Set the mode; BatchNorm keeps its means and variances in eval mode."""
        super().train(mode)
        if self.keeps_statistics:
            for module in self.modules():
                if isinstance(module, _BatchNorm):
                    module.eval()
        return self

    def forward(self, pixels: Float[Tensor, "batch 3 height width"]) -> list[Float[Tensor, "batch _ _ _"]]:
        maps: list[Tensor] = self.network(pixels * self.scale + self.shift)
        return maps


@contextmanager
def _downloading(name: str) -> Iterator[None]:
    """Convert the errors of downloading a network's weights to a ValueError, at once if there is no internet."""
    import timm
    from huggingface_hub import constants, try_to_load_from_cache

    try:
        # without an answer, the body would try again for a minute
        if not try_to_load_from_cache(timm.get_pretrained_cfg(name).hf_hub_id, constants.SAFETENSORS_SINGLE_FILE):
            urlopen(constants.ENDPOINT, timeout=WAIT).close()
        yield
    except OSError as error:
        reason = gist(getattr(error, "reason", error))
        raise ValueError(
            f"pretrained: expected a file, backbone.network.pretrained=FILE, or internet for {name} ({reason})"
        ) from None


def _freeze(network: nn.Module, patterns: Sequence[str]) -> None:
    """Take modules out of the training. Raises ValueError for a pattern that matches none."""
    modules = dict(network.named_modules())
    for pattern in patterns:
        matched = fnmatch.filter(modules, pattern)
        if not matched:
            raise ValueError(unknown(pattern, modules, "expected modules of the network", "unknown module"))
        for name in matched:
            modules[name].requires_grad_(False)
