"""A checkpoint is whole or absent, and what was written comes back."""

from pathlib import Path

import pytest
import torch

from phd_exp.records import files
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder
from phd_exp.training.checkpoints import AtomicCheckpoints, at_home


def test_what_was_written_comes_back(tmp_path: Path) -> None:
    file = tmp_path / "below" / "last.ckpt"
    AtomicCheckpoints(RunFolder(tmp_path)).save_checkpoint({"epoch": 3, "weights": torch.arange(5.0)}, str(file))
    back = AtomicCheckpoints(RunFolder(tmp_path)).load_checkpoint(str(file))
    assert back["epoch"] == 3
    assert torch.equal(back["weights"], torch.arange(5.0))
    AtomicCheckpoints(RunFolder(tmp_path)).remove_checkpoint(str(file))
    assert list(file.parent.iterdir()) == []


def test_a_failure_half_way_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "last.ckpt"
    AtomicCheckpoints(RunFolder(tmp_path)).save_checkpoint({"epoch": 3}, str(file))

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        AtomicCheckpoints(RunFolder(tmp_path)).save_checkpoint({"epoch": 4}, str(file))
    assert AtomicCheckpoints(RunFolder(tmp_path)).load_checkpoint(str(file))["epoch"] == 3
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]


PATHS = [
    "/home/diary", "~/diary", "file:///home/diary", "../diary", "a/../../diary", "diary", "photos/diary", "photos/",
]  # fmt: skip
NO_PATHS = ["", ".", "held_out/loss", "photos", "min", "nothing_here", "a" * 5000, "a\0b"]


def test_each_path_in_a_checkpoint_names_a_file_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for name in ("diary", "photos/diary"):
        (tmp_path / name).touch()
    home = tmp_path / "run" / "checkpoints"
    for path in PATHS:
        found = at_home({"a": [path], "b": {path: (path, {path})}}, home)
        (inside,) = found["a"]
        assert Path(inside).parent == home, path
        assert found == {"a": [inside], "b": {inside: (inside, {inside})}}
    for text in NO_PATHS:
        assert at_home({text: [text]}, home) == {text: [text]}
    for moved in ("/old/checkpoints", "/old/checkpoints/..", "checkpoints/.."):
        assert at_home(moved, home) == str(home)


def test_nothing_outside_the_run_is_deleted(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    folder.checkpoints.mkdir(parents=True)
    decoy = tmp_path / "diary"
    decoy.touch()
    (folder.path / "out").symlink_to(tmp_path)
    for path in (decoy, folder.checkpoints / "../../diary", folder.path / "out/diary"):
        with pytest.raises(RunError, match="diary: not deleted, since it is outside"):
            AtomicCheckpoints(folder).remove_checkpoint(path)
    assert decoy.exists()
