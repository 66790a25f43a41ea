"""The loop that most projects begin with, on the images of a rendered data set, for the programme to be held against.

Pictures are decoded from their files, one by one, by the workers of a DataLoader; the network computes in float32 and
in torch's own memory format; the errors of every sample are gathered in Python.
"""

import copy
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset
from torchvision.transforms.functional import normalize, pil_to_tensor

from phd_exp.data.batches import Batch
from phd_exp.geometry.camera import Camera
from phd_exp.metrics.errors import depth_error, projected_error
from phd_exp.models.regressor import IMAGENET_MEAN, IMAGENET_STD
from phd_exp.training.module import PositionModule

WORKERS = 2


class Pictures(Dataset[tuple[Tensor, Tensor, Tensor]]):
    """(pixels, position, focal length) of the first samples of a folder of pictures."""

    def __init__(self, folder: Path, labels: Batch) -> None:
        self.files = sorted(folder.glob("*.png"))[: len(labels)]
        self.labels, self.side = labels, int(labels.S)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, i: int) -> tuple[Tensor, Tensor, Tensor]:
        picture = Image.open(self.files[i]).convert("RGB")
        if picture.width != self.side:
            picture = picture.resize((self.side, self.side), Image.Resampling.BOX)
        pixels = normalize(pil_to_tensor(picture) / 255, IMAGENET_MEAN, IMAGENET_STD)
        return pixels, self.labels.xyz[i], self.labels.f[i]


class Conventional:
    """One epoch after another of such a loop, from its own copy of a module's network."""

    name = "conventional"

    def __init__(self, module: PositionModule, folder: Path, labels: Batch, batch_size: int) -> None:
        # contiguous whatever the programme chose, and the optimizer without its one kernel for all parameters
        self.regressor = copy.deepcopy(module.regressor).to(memory_format=torch.contiguous_format)
        self.loss, self.S = module.loss, labels.S
        self.optimizer = torch.optim.Adam(self.regressor.parameters(), lr=1e-3, foreach=False)
        pictures = Pictures(folder, labels)
        self.loader = DataLoader(
            pictures, batch_size, shuffle=True, num_workers=WORKERS, persistent_workers=True
        )

    def epoch(self) -> int:
        """Train on every sample once; how many there were."""
        errors = []
        for pixels, xyz, f in self.loader:
            camera = Camera(f, self.S)
            prediction = self.regressor.prediction(self.regressor.backbone(pixels), camera)
            loss = self.loss(prediction, xyz).mean()
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            estimates = prediction.mode.detach()
            for truth, estimate in zip(xyz, estimates, strict=True):
                errors.append((projected_error(truth, estimate).item(), depth_error(truth, estimate).item()))
        return len(errors)
