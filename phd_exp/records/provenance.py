"""What a run ran on: versions, commit, machine."""

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("phd_exp", "torch", "torchvision", "lightning", "hydra-core", "numpy")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that numbers depend on, as installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # run from a checkout that is not installed
            continue
    return found


def git_commit() -> str | None:
    """The commit of the checkout this package lies in; None outside one or without git."""
    try:
        answer = subprocess.run(
            ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"],
            capture_output=True,
            text=True,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None


def usable_cores() -> int:
    """How many cores this process may use: not all, where it is bound to some or a queue granted it fewer."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    granted = os.environ.get("SLURM_CPUS_PER_TASK", "")  # a queue may grant cores without binding to them
    return min(cores, int(granted)) if granted.isdigit() else cores


def machine() -> str:
    """Processor architecture and number of cores."""
    return f"{platform.machine()}, {os.cpu_count()} cores"
