"""A trained network, or an ensemble of networks and symmetric views, from images of its size to predictions."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from phd_exp.distributions import Mixture
from phd_exp.geometry.camera import Camera
from phd_exp.geometry.motion import EIGHT, turned
from phd_exp.models.heads import Prediction, SymmetricHead
from phd_exp.models.regressor import Regressor

BATCH = 64
PIXELS = BATCH * 512**2  # of the images that a network receives at once


class TrainedNetwork(nn.Module):
    """One or several networks without gradients, each of which receives one or eight symmetric views of an image.

    An ensemble predicts the Projected Huber distribution that is closest to the mixture of its members.

    Args:
        networks: the members; those of an ensemble have a `SymmetricHead`.
        side: side of the network's image, pixels.
        constant_f: the focal length that the network receives for every image, px; None: the true one.
        views: number of symmetric views of each image, 1 or 8.

    Raises ValueError if the predictions of several members cannot be combined.
    """

    networks: Sequence[Regressor]

    def __init__(self, networks: Sequence[Regressor], side: int, constant_f: float | None, views: int = 1) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)  # type: ignore[assignment]
        self.requires_grad_(False).eval()
        self.head = networks[0].head
        self.side, self.constant_f, self.views = side, constant_f, views
        if self.is_ensemble and not isinstance(self.head, SymmetricHead):
            raise ValueError("predicts no uncertainty, so that it joins no ensemble; expected model=probabilistic")

    @property
    def is_ensemble(self) -> bool:
        """Whether it has several members."""
        return len(self.networks) * self.views > 1

    def camera(self, f: Float[Tensor, "*batch"]) -> Camera:
        """The camera as the network receives it."""
        return Camera(f, float(self.side)).with_constant_f(self.constant_f)

    def raw(
        self, images: UInt8[Tensor, "batch S S 3"], f: Float[Tensor, " batch"]
    ) -> Float[Tensor, "batch *members n_outputs"]:
        """The raw numbers, on the CPU, at most 64 images at a time, fewer large ones; f in pixels of its images."""
        device = next(self.buffers()).device
        known = self.camera(f.float().to(device)).f
        n = max(1, min(BATCH, PIXELS // self.side**2) // self.views)
        batches = zip(images.split(n), known.split(n), strict=True)
        return torch.cat([self.outputs(image.to(device), f).cpu() for image, f in batches])

    def outputs(
        self, image: UInt8[Tensor, "batch S S 3"], f: Float[Tensor, " batch"]
    ) -> Float[Tensor, "batch *members n_outputs"]:
        """The raw numbers of the network, or of all members of an ensemble, in the frame of each image."""
        if not self.is_ensemble:
            return self.networks[0].raw(image, f)
        signs = EIGHT[: self.views]
        views = torch.stack([turned(image, sign) for sign in signs], dim=1).flatten(0, 1)
        f = f.repeat_interleave(self.views)
        raw = torch.stack([one.raw(views, f).unflatten(0, (-1, self.views)) for one in self.networks], dim=1)
        assert isinstance(self.head, SymmetricHead)  # see `__init__`
        return self.head.turned_back(raw, torch.tensor(signs).to(raw)).flatten(1, 2)

    def members(
        self, raw: Float[Tensor, "*batch members n"], f: Float[Tensor, "*batch"], dtype: torch.dtype = torch.float64
    ) -> Mixture:
        """The mixture of an ensemble's predictions from its raw numbers."""
        prediction = self.head(raw.to(dtype), self.camera(f.to(dtype)[..., None]))
        assert prediction.has_closed_forms  # as all with a `SymmetricHead`
        return Mixture(prediction)

    def predict(
        self, raw: Float[Tensor, "*members n_outputs"], f: Float[Tensor, "*batch"], dtype: torch.dtype = torch.float64
    ) -> Prediction:
        """Predictions from raw numbers, which have a dimension for the members of an ensemble before the last."""
        if self.is_ensemble:
            return self.members(raw, f, dtype).closest
        return self.head(raw.to(dtype), self.camera(f.to(dtype)))
