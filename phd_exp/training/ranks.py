"""Training one run with several processes, which end together.

Lightning would start the command of this process again, which in a sweep is the whole sweep. Here each process is a
`Child` that runs `rank.py`, whatever launcher runs the job.
"""

import socket
from contextlib import ExitStack
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from phd_exp.records.errors import RunError
from phd_exp.records.processes import Child
from phd_exp.training.config import RunConfig
from phd_exp.training.recorder import Draw

Share = tuple[RunConfig, Path, Draw | None, int, int]
"""The task of one process: the run, its folder, how curves are drawn, the number of threads, and the rank."""


def train_together(config: RunConfig, folder: Path, draw: Draw | None, threads: int) -> dict[str, Any]:
    """Train one run with `trainer.devices` processes, which share the threads; returns its results.

    Raises the error of the first process to fail; the others are ended.
    """
    world = config.trainer.devices
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": str(world), "NODE_RANK": "0"}
    results: dict[int, dict[str, Any]] = {}
    with ExitStack() as stack:
        ranks: dict[Any, tuple[int, Child]] = {}
        for rank in range(world):
            of_rank = environment | {"RANK": str(rank), "LOCAL_RANK": str(rank)}
            child = stack.enter_context(Child("phd_exp.training.rank", of_rank))
            child.send((config, folder, draw, max(1, threads // world), rank))
            ranks[child.connection] = (rank, child)
        try:
            while ranks:
                for connection in wait(list(ranks)):
                    rank, child = ranks.pop(connection)
                    results[rank] = _received(child, f"rank {rank} of {world}")
        except BaseException:
            for _, child in ranks.values():
                child.process.kill()  # at once: Gloo would print that it lost a peer
            raise
    return results[0]


def _received(child: Child, name: str) -> dict[str, Any]:
    try:
        outcome = child.receive()
    except EOFError as death:
        raise RunError(
            f"{name}: {death}; the others were ended, and the same command goes on from the last checkpoint"
        ) from None
    if isinstance(outcome, Exception):
        raise outcome
    results: dict[str, Any] = outcome
    return results
