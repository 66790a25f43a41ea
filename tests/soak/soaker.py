"""A process that renders and trains for long: `python soaker.py ROUNDS WORD...` in a folder of its own.

Prints, as a JSON line each, what it holds after a first round and after ROUNDS more. A round is `IMAGES` images by
which a data set grows and a sweep of `JOBS` runs.
"""

import gc
import json
import os
import sys
from pathlib import Path

from phd_exp.__main__ import main

IMAGES, JOBS = 25, 10
OWN = ("renders", "runs")
"""What a command is meant to leave in the folder it is given in."""


def play(number: int, words: list[str]) -> None:
    """One round. Raises RuntimeError where a command fails."""
    grown = f"data.n_train={IMAGES * (number + 1)}"
    seeds = ",".join(str(seed) for seed in range(JOBS * number, JOBS * (number + 1)))
    for command in (["render", *of_data(words), grown], ["-m", *words, f"seed={seeds}"]):
        if status := main(command):
            raise RuntimeError(f"round {number} ended with status {status}: {' '.join(command)}")


def of_data(words: list[str]) -> list[str]:
    """The words that `render` takes too."""
    return [word for word in words if word.startswith(("preset=", "data."))]


def held() -> dict[str, int]:
    """What this process has and has left: kB, and otherwise numbers; of files, those that are no one's record."""
    gc.collect()
    folders = [Path.cwd(), *(Path(os.environ[name]) for name in ("HOME", "TMPDIR"))]
    files = [
        [file for file in folder.rglob("*") if file.relative_to(folder).parts[0] not in OWN] for folder in folders
    ]
    return {
        "memory": memory(os.getpid()),
        "handles": len(os.listdir("/proc/self/fd")),
        "threads": len(os.listdir("/proc/self/task")),
        "processes": len(marked()),
        "files in the working folder": len(files[0]),
        "files of sweeps that have ended": len(list(Path("runs/.sweep").rglob("*"))),
        "files at home": len(files[1]),
        "temporary files": len(files[2]),
    }


def marked() -> list[int]:
    """This process and those that it started, whoever is their parent now: they have its environment."""
    mark = f"SOAK={os.environ['SOAK']}".encode()
    return [int(entry.parent.name) for entry in Path("/proc").glob("[0-9]*/environ") if mark in content(entry)]


def memory(process: int) -> int:
    """Resident, kB; 0 of a process that has ended."""
    lines = content(Path(f"/proc/{process}/status")).decode().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("VmRSS:"))


def content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError:
        return b""


if __name__ == "__main__":
    rounds, words = int(sys.argv[1]), sys.argv[2:]
    for number in range(rounds + 1):
        play(number, words)
        if number in (0, rounds):
            print(json.dumps(held()), flush=True)
