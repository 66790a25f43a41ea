"""What somebody else's files would do if they could, and do not."""

import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from phd_exp.cli.train import run_name
from phd_exp.data.cache import cached
from phd_exp.training.config import check
from tests.bad_input import images
from tests.bad_input.place import Place
from tests.bad_input.table import LEARN, ONE, PREDICT, REPORT, Trap, trap

LONGER = (*(word for word in LEARN if "max_epochs" not in word), "trainer.max_epochs=2")


@pytest.fixture
def command(place: Place, phd_exp: Callable) -> Callable:
    run = str(place.run.path.relative_to(place.root))
    return lambda *words: phd_exp(*(word.replace("RUN", run) for word in words))


def go_on(place: Place, composed: Callable[..., dict[str, Any]]) -> None:
    """Let the run look broken off after the first of two epochs."""
    words = list(LONGER)
    place.put_config(trainer__max_epochs=2)
    place.put_json(place.run.status_file, state="interrupted")
    place.run.path.rename(place.root / run_name(check(composed(*words)), words).folder(Path("runs")))


def test_a_resumed_checkpoint_removes_nothing(
    place: Place, command: Callable, composed: Callable[..., dict[str, Any]]
) -> None:
    """Lightning removes what a checkpoint calls the best one before; the way out of the folder is hidden in it."""
    place.put("diary", "dear")
    go_on(place, composed)
    content = torch.load(place.run.last_checkpoint, weights_only=True)
    state = {"dirpath": str(place.run.checkpoints), "best_model_path": f"{place.run.checkpoints}/{'../' * 6}diary"}
    assert Path(state["best_model_path"]).exists()
    names = [name for name in content["callbacks"] if "ModelCheckpoint" in name]
    place.put_checkpoint(callbacks={name: content["callbacks"][name] | state for name in names})
    outcome = command(*LONGER)
    assert outcome.status == 0, outcome.err
    assert len(names) == 1
    assert [row["epoch"] for row in place.run.metrics()] == [-1, 0, 1], "the run was resumed"
    assert (place.root / "diary").read_text() == "dear"


def test_a_report_neither_opens_checkpoints_nor_writes_through_links(place: Place, command: Callable) -> None:
    trap(place)
    place.put("diary", "dear")
    images.link(place.run.path / ".lock", place.root / "diary")
    place.put_json(place.run.status_file, state="running")
    assert command(*REPORT).status == 0
    assert not (place.root / "owned").exists()
    assert (place.root / "diary").read_text() == "dear"


def test_no_ghostscript_is_called(place: Place, command: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    place.put("bin/gs", f"#!/bin/sh\ntouch {place.root}/owned\n")
    (place.root / "bin/gs").chmod(stat.S_IRWXU)
    monkeypatch.setenv("PATH", f"{place.root}/bin:{os.environ['PATH']}")
    place.put(place.photo, images.POSTSCRIPT)
    assert command(*PREDICT).status == 1
    assert not (place.root / "owned").exists()


def kept(cache: Path) -> np.ndarray:
    """Decoded images as a data set keeps them."""

    def fill(array: np.ndarray, row: int) -> None:
        array[row] = row + 1

    return cached(cache / "images.npy", {"layout": 1}, (3, 2), range(3), fill, "decoding")


@pytest.mark.parametrize("content", ["pickle", "array of another shape", "pipe", "text"])
def test_a_cache_that_came_with_the_images_is_made_anew(tmp_path: Path, content: str) -> None:
    kept(tmp_path)
    file = tmp_path / "images.npy"
    if content == "pickle":
        np.save(file, np.array([Trap(str(tmp_path / "owned"))], dtype=object), allow_pickle=True)
    elif content == "array of another shape":
        np.save(file, np.zeros((1, 2), dtype=np.uint8))
    elif content == "pipe":
        images.pipe(file)
    else:
        file.write_text("no array")
    np.testing.assert_array_equal(kept(tmp_path), [[1, 1], [2, 2], [3, 3]])
    assert not (tmp_path / "owned").exists()


def test_a_cache_that_leads_elsewhere_is_not_written_through(tmp_path: Path) -> None:
    (tmp_path / "diary").write_text("dear")
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "images.unfinished").symlink_to(tmp_path / "diary")
    kept(tmp_path / "cache")
    assert (tmp_path / "diary").read_text() == "dear"


def test_no_variable_of_the_environment_is_read(
    place: Place, command: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "sesame-7391")
    place.put_config(data__name="${oc.env:SECRET}")
    outcome = command(*ONE)
    assert outcome.status == 1
    assert "sesame-7391" not in outcome.err
    command(*REPORT)
    pages = [page.read_text() for page in place.root.glob("report/site/**/*.*") if page.suffix in (".html", ".js")]
    assert pages
    assert not any("sesame-7391" in page for page in pages)
