"""A checkpoint is whole or absent, and what was written comes back."""

from pathlib import Path
from typing import Any

import pytest
import torch

from phd_exp.records import files
from phd_exp.records.errors import RunError
from phd_exp.training.checkpoints import AtomicCheckpoints


def test_what_was_written_comes_back(tmp_path: Path) -> None:
    file = tmp_path / "below" / "last.ckpt"
    AtomicCheckpoints().save_checkpoint({"epoch": 3, "weights": torch.arange(5.0)}, str(file))
    back = AtomicCheckpoints().load_checkpoint(str(file))
    assert back["epoch"] == 3
    assert torch.equal(back["weights"], torch.arange(5.0))
    AtomicCheckpoints().remove_checkpoint(str(file))
    assert list(file.parent.iterdir()) == []


def test_a_failure_half_way_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "last.ckpt"
    AtomicCheckpoints().save_checkpoint({"epoch": 3}, str(file))

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        AtomicCheckpoints().save_checkpoint({"epoch": 4}, str(file))
    assert AtomicCheckpoints().load_checkpoint(str(file))["epoch"] == 3
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]


def test_code_in_a_checkpoint_is_not_run(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return Path.touch, (tmp_path / "sprung",)

    torch.save({"epoch": Trap()}, tmp_path / "last.ckpt")
    with pytest.raises(RunError, match="holds more than tensors and plain values"):
        AtomicCheckpoints().load_checkpoint(str(tmp_path / "last.ckpt"), weights_only=False)
    assert not (tmp_path / "sprung").exists()


def test_a_broken_checkpoint_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "last.ckpt"
    AtomicCheckpoints().save_checkpoint({"epoch": 3}, str(file))
    content = file.read_bytes()
    for broken in (content[: len(content) // 2], b"", b"no checkpoint"):
        file.write_bytes(broken)
        with pytest.raises(RunError, match=r"last\.ckpt: not a whole checkpoint .*; delete it") as caught:
            AtomicCheckpoints().load_checkpoint(str(file))
        assert "\n" not in str(caught.value)
