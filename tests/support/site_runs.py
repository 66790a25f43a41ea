"""Records of runs of each kind for a report: good, bad and hostile."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from phd_exp.records.choices import RunName
from phd_exp.records.runs import RunFolder
from tests.support.several import write_views
from tests.support.synthetic import write_run

OWNED = "window.owned=1"
HOSTILE = (
    f"'\"><img src=x onerror={OWNED}><svg onload={OWNED}></script><script>{OWNED}</script>"
    f'<a href="javascript:{OWNED}">x</a>{{{{7*7}}}}\u2028&lt;b&gt;%3Cb%3E'
)
"""A text that tries to execute code in the reader's browser."""
NAME = HOSTILE.replace("/", "")[:120]
"""The same as a name of a folder or a file."""


def write_runs(folder: Path) -> Path:
    """A calibrated, a recalibrated and an overridden run, a baseline; failed, interrupted and unreadable runs."""
    runs, images = folder / "runs", folder / "renders" / "default" / "test"
    images.mkdir(parents=True)
    random = np.random.default_rng(0)
    for index in range(100):
        Image.fromarray(random.integers(0, 255, (56, 56, 3), dtype=np.uint8)).save(images / f"{index:06d}.png")
    write_run(runs, "default", n=100, root=folder / "renders")
    certain = write_run(runs, "occl", n=100, overconfidence=2.0)
    held_out = write_run(folder / "elsewhere", "occl", seed=1, n=100, overconfidence=2.0)
    held_out.predictions.rename(certain.path / "held_out.parquet")
    write_views(certain.views, 50)
    _rewrite(certain)
    write_run(runs, "default", "mae_logz", n=100, root=folder / "renders")
    write_run(runs, "default", "mae_vz", preset="demo", overrides=("optimizer.lr=0.1",), n=100)
    _fail(_folder(runs, "occl", "mae_vz"))
    broken_off = _folder(runs, "scale", "probabilistic")
    with broken_off.recording(data_manifest=None):
        status = broken_off.status()
    broken_off.write_status(status.model_copy(update={"state": "running"}))
    _folder(runs, "scale", "mae_vz").status_file.write_text("{")
    _rewrite(write_run(runs, NAME, "mae_vz", preset="a<b>'\"&", n=40, epochs=2, root=folder / "renders"))
    hostile = folder / "renders" / NAME / "test"
    hostile.mkdir(parents=True)
    shutil.copy(images / "000000.png", hostile / f"{NAME}.png")
    return runs


def _rewrite(folder: RunFolder) -> None:
    """Put the hostile text wherever a run record holds a text."""
    folder.config_file.write_text(
        json.dumps(folder.config() | {HOSTILE: {HOSTILE: HOSTILE}, "model": {"name": HOSTILE}})
    )
    status = json.loads(folder.status_file.read_text())
    texts = dict.fromkeys(("machine", "git_commit", "data_manifest", "traceback", "error"), HOSTILE)
    folder.status_file.write_text(
        json.dumps(status | texts | {"versions": {HOSTILE: HOSTILE}, "overrides": [HOSTILE]})
    )
    folder.write_metrics([row | {HOSTILE: 1.0, f"test/{HOSTILE}": float(row["epoch"])} for row in folder.metrics()])
    pd.read_parquet(folder.predictions).assign(file_name=f"{NAME}.png").to_parquet(folder.predictions)


def _fail(folder: RunFolder) -> None:
    folder.write_config({"model": {"name": HOSTILE}})
    folder.write_metrics([{"epoch": -1, "test/nll": 3.0, HOSTILE: 1.0}, {"epoch": 0, "test/nll": None}])
    with pytest.raises(ValueError, match="script"), folder.recording(data_manifest=None):
        raise ValueError(f"</script><script>window.owned=1</script>{HOSTILE}")


def _folder(runs: Path, data: str, model: str) -> RunFolder:
    folder = RunFolder(RunName("small", data, model, 0).folder(runs))
    folder.path.mkdir(parents=True)
    return folder
