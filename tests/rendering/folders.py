"""What tests of interrupted renders share: what lies in a folder, waiting, and work in a process of its own."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.rays import NOTHING, Hits, Mask

HOME = Path(__file__).parents[2]
PATIENCE = 60.0  # s


def contents(folder: DatasetFolder) -> dict[str, bytes]:
    """Every file of a data set, without what programmes keep for themselves."""
    files = (path for path in folder.root.rglob("*") if path.is_file() and folder.cache not in path.parents)
    return {str(path.relative_to(folder.root)): path.read_bytes() for path in files}


def wait_until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.005)


@contextmanager
def in_a_process(
    call: str, folder: DatasetFolder, spec: DatasetSpec, **options: Any
) -> Iterator[subprocess.Popen[Any]]:
    """A call, in terms of `folder` and `spec`, in a process of its own, which is killed at the end."""
    script = (
        # a shell lets what it runs in the background ignore interrupts, and so would this
        "import signal\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from phd_exp.records.dataset import DatasetFolder\n"
        "from phd_exp.records.shards import Shard\n"
        "from phd_exp.records.spec import DatasetSpec\n"
        "from phd_exp.rendering.render import render_shard\n"
        "from phd_exp.rendering.render import ensure_rendered\n"
        f"spec = DatasetSpec.model_validate_json({spec.model_dump_json()!r})\n"
        f"folder = DatasetFolder({str(folder.root)!r})\n"
        f"{call}\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], cwd=HOME, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def silhouettes(hits: Hits) -> Mask:
    """Pixels (S, S) that show any object, rows from the top."""
    return np.asarray((hits.surfaces != NOTHING).any(axis=0))
