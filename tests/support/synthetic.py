"""Complete run records, with predictions drawn so that their calibration is known."""

from pathlib import Path

import torch
from torch import Tensor

from phd_exp.data.batches import Batch
from phd_exp.distributions import ProjectedHuber
from phd_exp.distributions.huber import sample_whitened
from phd_exp.distributions.point_estimate import PointEstimate
from phd_exp.geometry.charts import Cartesian, DepthScale
from phd_exp.records.choices import RunName
from phd_exp.records.runs import SECTIONS, RunFolder
from phd_exp.training.predictions import columns, summary, write_parquet

PRECISION = {"default": (30.0, 900.0), "occl": (12.0, 250.0), "scale": (9.0, 900.0), "occl_scale": (7.0, 200.0)}


def _spread(shape: tuple[int, ...], factor: float, random: torch.Generator) -> Tensor:
    return torch.exp(factor * torch.randn(shape, generator=random, dtype=torch.float64))


def calibrated(xyz: Tensor, a: float, A: float, overconfidence: float, seed: int) -> ProjectedHuber:
    """Predictions for true positions: exactly calibrated ones if overconfidence is 1, else so much too precise."""
    torch.manual_seed(seed)
    random = torch.Generator().manual_seed(seed)
    n = len(xyz)
    of_depth = a * _spread((n,), 0.5, random)
    across = A * _spread((n,), 0.4, random)
    shape = _spread((n,), 0.2, random)
    tilt = 0.3 * torch.randn(n, generator=random, dtype=torch.float64).clamp(-2, 2)
    matrix = across[:, None, None] * torch.stack(
        [torch.stack([shape, tilt], -1), torch.stack([tilt, (1 + tilt**2) / shape], -1)], -2
    )
    unit = ProjectedHuber(
        torch.zeros(n, 2, dtype=torch.float64), torch.ones(n, dtype=torch.float64), matrix, of_depth
    )
    t = unit.rsample()[:, 2]
    q = sample_whitened(torch.Size([n]), dtype=torch.float64, device=torch.device("cpu"))
    off = torch.linalg.solve(matrix, q[..., None])[..., 0] / t[:, None]
    mu_xy = xyz[:, :2] / xyz[:, 2:] - off
    return ProjectedHuber(mu_xy, xyz[:, 2] / t, matrix * overconfidence, of_depth * overconfidence)


def truths(n: int, seed: int) -> tuple[Tensor, Tensor]:
    """Positions over the whole image, as the rendered data sets have them, and focal lengths."""
    random = torch.Generator().manual_seed(seed)
    share = torch.rand((n, 4), generator=random, dtype=torch.float64)
    f, z = 1200 + 800 * share[:, 0], 3 + 2 * share[:, 1]
    xy = 224 * (z / f)[:, None] * (share[:, 2:] - 0.5)
    return torch.cat([xy, z[:, None]], -1), f


def write_run(
    runs: Path,
    data: str = "default",
    model: str = "probabilistic",
    *,
    preset: str = "small",
    seed: int = 0,
    overrides: tuple[str, ...] = (),
    n: int = 300,
    epochs: int = 6,
    overconfidence: float = 1.0,
    truth: tuple[Tensor, Tensor] | None = None,
    root: Path | None = None,
) -> RunFolder:
    """A finished run with all its files; `truth` says where the objects are, `root` where images would lie."""
    folder = RunFolder(RunName(preset, data, model, seed, overrides).folder(runs))
    folder.path.mkdir(parents=True)
    xyz, f = truths(n, seed=1) if truth is None else truth
    prediction = calibrated(xyz, *PRECISION.get(data, (30.0, 900.0)), overconfidence, seed)
    image = torch.zeros(len(xyz), 1, 1, 3, dtype=torch.uint8)
    batch = Batch(image, xyz, f, S=224.0, row=torch.arange(len(xyz)))
    estimate = prediction if model == "probabilistic" else _point(prediction.mode, batch)
    table = columns(estimate, batch)
    share = torch.rand(len(xyz), generator=torch.Generator().manual_seed(2)).tolist()
    known = {
        "file_name": [f"{i:06d}.png" for i in range(len(xyz))],
        "f": f.tolist(),
        "S": [224] * len(xyz),
        "scale": [1.0] * len(xyz),
        "visibility": share,
        "truncation": [max(0.0, 0.5 - value) for value in share],
    }
    with folder.recording(data_manifest="0" * 16, overrides=overrides):
        spec = {"variant": data, "sensor_size": 224}
        where = {"root": str(root or runs / "renders"), "spec": spec}
        sections = {name: {"name": "any"} for name in SECTIONS} | {"data": where, "model": {"name": model}}
        folder.write_config({"seed": seed, "preset": preset} | sections)
        folder.write_metrics(_history(summary(table), epochs))
        folder.write_results(summary(table))
        write_parquet(folder.predictions, table, known)
    return folder


def _point(position: Tensor, batch: Batch) -> PointEstimate:
    chart = Cartesian(DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0)))
    return PointEstimate(chart.coordinates(position, batch.camera), chart, batch.camera)


def _history(final: dict[str, float], epochs: int) -> list[dict[str, float]]:
    """An untrained network that approaches the final numbers."""
    rows = []
    for epoch in range(-1, epochs):
        left = 0.5 ** (epoch + 1)
        row: dict[str, float] = {"epoch": epoch, "step": 10 * (epoch + 1)}
        for key, value in final.items():
            row[key] = value * (1 + 3 * left) if "precision" not in key else value / (1 + 9 * left)
            row[key.replace("test/", "train/")] = row[key] * (0.97 + 0.03 * left)
        row["test/loss"] = row["train/loss"] = left
        rows.append(row)
    return rows
