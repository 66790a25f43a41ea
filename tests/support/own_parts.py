"""Parts of a user's own, as files in the folder where commands are run, and data that needs no rendering."""

from pathlib import Path

NET = """
import torch
from torch import nn

class Mine(nn.Module):
    def __init__(self, width: int = 8):
        super().__init__()
        self.layer = nn.Conv2d(3, width, 3, 2)

    def forward(self, images):
        return self.layer(images).relu()

class Raises(Mine):
    def forward(self, images):
        raise KeyError("boom")

class Scalar(Mine):
    def forward(self, images):
        return images.sum()

class NaN(Mine):
    def forward(self, images):
        return super().forward(images) * float("nan")

class Later(Mine):
    calls = 0

    def forward(self, images):
        Later.calls += 1
        if Later.calls > 9:
            raise RuntimeError("later")
        return super().forward(images)

class Maps(Mine):
    def forward(self, images):
        fine = super().forward(images)
        return {"fine": fine, "coarse": fine[..., ::2, ::2]}

class NoModule:
    pass
"""
LOSS = """
def l1(prediction, xyz, weight: float = 1.0):
    return weight * (prediction.mode - xyz).abs().sum(-1)

def wrong_shape(prediction, xyz):
    return prediction.mode
"""
OTHERS = """
import lightning
import torch
from lightning.pytorch.loggers.logger import DummyLogger
from phd_exp.data.batches import Batch
from phd_exp.data.sources import Source
from phd_exp.geometry import DepthScale
from phd_exp.models.heads import DistributionHead

class Head(DistributionHead):
    pass

class Raising(lightning.Callback):
    def on_train_epoch_end(self, trainer, module):
        if trainer.current_epoch == 1:
            raise ZeroDivisionError("my callback")

class Keeping(DummyLogger):
    rows = []

    def log_metrics(self, metrics, step=None):
        self.rows.append((step, metrics))

class Squares(Source):
    def __init__(self, n, side):
        self.n, self.side, self.constant_f = n, side, 2.0 * side
        self.depth = DepthScale.from_ranges(f_range=(1.5 * side, 2.5 * side), z_range=(3.0, 5.0))

    def samples(self, part):
        n, side = self.n[part], self.side
        z = 3 + 2 * torch.rand(n, generator=torch.Generator().manual_seed(len(part)))
        across = (torch.arange(side) - side / 2).abs()
        inside = across < side / z[:, None]
        image = (128 * (inside[:, None] & inside[:, :, None]))[..., None].repeat(1, 1, 1, 3).to(torch.uint8)
        xyz = torch.stack([torch.zeros(n), torch.zeros(n), z], dim=-1)
        return Batch(image, xyz, torch.full((n,), self.constant_f), float(side), torch.arange(n))

    def known(self, part):
        return {"file_name": [f"{part}-{row}" for row in range(self.n[part])]}

    def count(self, part):
        return self.n[part]
"""
FILES = {
    "ownnet.py": NET,
    "ownloss.py": LOSS,
    "ownparts.py": OTHERS,
    "broken.py": "import nothing_here\n",
    "my_conf/backbone/mine.yaml": "_target_: ownnet.Mine\n",
    "my_conf/backbone/pooled.yaml": "_target_: phd_exp.models.backbones.pooled\nnetwork: {_target_: ownnet.Mine}\n"
    "side: ${data.image_size}\n",
    "my_conf/backbone/located.yaml": "_target_: phd_exp.models.locating.LocatingNetwork\n"
    "network: {_target_: ownnet.Maps}\nside: ${data.image_size}\nchannels: 8\nsegments: false\n",
    "my_conf/loss/l1.yaml": "_target_: ownloss.l1\nweight: 2.0\n",
    "my_conf/model/own.yaml": "defaults: [/loss@_global_.loss: nll]\nname: own\nhead: {_target_: ownparts.Head}\n",
    "my_conf/data/squares.yaml": "name: squares\nsource: {_target_: ownparts.Squares}\nn_train: 32\nn_held_out: 8\n"
    "n_test: 16\nimage_size: 32\nbatch_size: 16\n",
}
QUICK = (
    "--config-dir=my_conf", "data=squares", "backbone=mine", "preset=smoke", "logger=none",
    "trainer.progress_bar=false", "trainer.threads=1",
)  # fmt: skip
"""A run of a second, of the parts above."""


def write_own_parts(folder: Path) -> None:
    """Write all files."""
    for name, content in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
