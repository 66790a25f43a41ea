"""What somebody else's files would do if they could, and do not."""

import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from phd_exp.cli import choices_of
from phd_exp.cli.train import run_name
from phd_exp.config import check
from phd_exp.data.cache import cached
from phd_exp.records.runs import RunFolder
from tests.bad_input import images
from tests.bad_input.place import LEARN, ONE, PREDICT, REPORT, Place, spoil_checkpoint
from tests.bad_input.table import PHOTO, Trap, trap

OWN = """
import os
import lightning

class Keeping(lightning.Callback):
    best = []

    def state_dict(self):
        return {"best": self.best}

    def load_state_dict(self, state):
        self.best = state["best"]

    def on_train_epoch_end(self, trainer, module):
        for path in self.best:
            if os.path.exists(path):
                os.remove(path)
"""
"""A user's own callback that deletes what it has kept."""


@pytest.fixture
def command(place: Place, phd_exp: Callable) -> Callable:
    return lambda *words: phd_exp(*map(place.named, words))


def claimed(state: dict[str, Any], decoy: str) -> dict[str, Any]:
    """A callback's state as a stranger may write it: whatever path it asks for is a decoy, and every score is bad."""
    worst = torch.tensor(torch.inf)
    paths = dict.fromkeys(("best_model_path", "kth_best_model_path", "last_model_path"), decoy)
    scores = {"best_k_models": {decoy: worst}, "best_model_score": worst, "kth_value": worst}
    return state | paths | scores | {"best": [decoy]}


def test_a_resumed_checkpoint_deletes_nothing_outside_its_run(
    place: Place, command: Callable, composed: Callable[..., dict[str, Any]]
) -> None:
    """Lightning deletes what a checkpoint calls the best one before; the way out of the folder is hidden in it."""
    place.put("own.py", OWN)
    kinds = (f"callbacks=[{','.join(choices_of('callbacks'))}]", "+callbacks.own._target_=own.Keeping", "logger=csv")
    common = [word for word in LEARN if "n_held_out" not in word and "logger" not in word]
    words = [*common, "data.n_train=4", "data.n_held_out=2", "runs=strange", *kinds]
    assert command(*words).status == 0
    (path,) = place.root.glob("strange/*/*/*/seed*")
    # the run looks interrupted after the first of two epochs
    run, longer = RunFolder(path), [*words, "trainer.max_epochs=2"]
    config = run.config()
    config["trainer"]["max_epochs"] = 2
    run.write_config(config)
    place.put_json(run.status_file, state="interrupted")
    longer.remove("trainer.max_epochs=1")
    name = run_name(check(composed(*(word for word in longer if "own." not in word))), longer)
    resumed = RunFolder(path.rename(place.root / name.folder(Path("strange"))))
    states = torch.load(resumed.last_checkpoint, weights_only=True)["callbacks"]
    up = f"{resumed.checkpoints.relative_to(place.root)}{'/..' * 6}"
    decoys = [f"diary{number}" for number in range(len(states))]
    for decoy, name in zip(decoys, states, strict=True):
        place.put(decoy, "dear")
        assert (place.root / f"{up}/{decoy}").exists()
        home = {"dirpath": str(resumed.checkpoints.relative_to(place.root))} if "dirpath" in states[name] else {}
        states[name] = claimed(states[name] | home, f"{up}/{decoy}")
    spoil_checkpoint(resumed.last_checkpoint, callbacks=states)
    outcome = command(*longer)
    assert outcome.status == 0, outcome.err
    assert [row["epoch"] for row in resumed.metrics()] == [-1, 0, 1], "the run was resumed"
    assert [decoy for decoy in decoys if not (place.root / decoy).exists()] == []


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
    place.put(PHOTO, images.POSTSCRIPT)
    assert command(*PREDICT).status == 1
    assert not (place.root / "owned").exists()


def kept(cache: Path) -> np.ndarray:
    """Decoded images as a data set keeps them."""

    def fill(array: np.ndarray, row: int) -> None:
        array[row] = row + 1

    return cached(cache / "images.npy", {"layout": 1}, (3, 2), range(3), fill, "decoding")


def test_a_cache_that_came_with_the_images_is_made_anew_and_not_written_through(tmp_path: Path) -> None:
    kept(tmp_path)
    file, diary = tmp_path / "images.npy", tmp_path / "diary"
    np.save(file, np.array([Trap(str(tmp_path / "owned"))], dtype=object), allow_pickle=True)
    diary.write_text("dear")
    (tmp_path / "images.unfinished").symlink_to(diary)
    for spoil in (lambda: None, lambda: np.save(file, np.zeros((1, 2), np.uint8)), lambda: images.pipe(file)):
        spoil()
        np.testing.assert_array_equal(kept(tmp_path), [[1, 1], [2, 2], [3, 3]])
    assert not (tmp_path / "owned").exists()
    assert diary.read_text() == "dear"


def test_no_variable_of_the_environment_is_read(
    place: Place, command: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "sesame-7391")
    place.put_config(data=place.run.config()["data"] | {"name": "${oc.env:SECRET}"})
    outcome = command(*ONE)
    assert outcome.status == 2
    assert "sesame-7391" not in outcome.err
    command(*REPORT)
    pages = [page.read_text() for page in place.root.glob("report/site/**/*.*") if page.suffix in (".html", ".js")]
    assert pages
    assert not any("sesame-7391" in page for page in pages)
