"""Small disks that can be filled, and turned read-only."""

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

KIB = 1024


@contextmanager
def small_disk(place: Path, kib: int) -> Iterator[Path]:
    """A disk of its own at a new folder. Skips the test where it cannot be had."""
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(place)]
    if not shutil.which("mount") or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small disk takes root, and a system that lets root mount")
    try:
        yield place
    finally:
        subprocess.run(["umount", str(place)], check=True)


def leave_room(disk: Path, room: int) -> None:
    """Fill a disk up to some bytes, by a file that `make_room` removes."""
    make_room(disk)
    free = shutil.disk_usage(disk).free
    _ballast(disk).write_bytes(bytes(free - room))
    assert shutil.disk_usage(disk).free == room


def make_room(disk: Path) -> None:
    _ballast(disk).unlink(missing_ok=True)


def remount(disk: Path, rights: str) -> None:
    """Make a disk `ro` or `rw`."""
    subprocess.run(["mount", "-o", f"remount,{rights}", str(disk)], check=True)


def _ballast(disk: Path) -> Path:
    return disk / "ballast"
