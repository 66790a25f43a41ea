"""One task in several processes, which end together.

Lightning would start the command of this process again, which in a sweep is the whole sweep.
"""

import os
import signal
import socket
import sys
import traceback
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import wait
from multiprocessing.queues import SimpleQueue
from typing import Any

import torch.distributed as dist
from torch.multiprocessing.spawn import start_processes

from phd_exp.records.errors import RunError, UserError

Work = Callable[[int, int], dict[str, Any]]
"""Number of threads and rank -> results. It is sent to each process, so it must pickle."""


def together(work: Work, world: int, threads: int) -> dict[str, Any]:
    """Do the work in `world` processes, which share the threads; returns the results of rank 0.

    Raises the error of the first process to fail, RunError if it was killed; the others are ended.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    answers = get_context("spawn").SimpleQueue()
    arguments = (work, max(1, threads // world), world, port, answers)
    ranks = start_processes(_main, arguments, world, join=False).processes  # ended when this process dies
    try:
        running = {rank.sentinel for rank in ranks}
        while running and not any(rank.exitcode for rank in ranks):
            running -= set(wait(running))
        # the peer of a killed process fails too, and on a busy machine both are noticed at once
        code, number = min((rank.exitcode or 0, number) for number, rank in enumerate(ranks))
        if code < 0:
            raise RunError(
                f"rank {number} of {world}: process {ranks[number].pid} was killed by {signal.Signals(-code).name}; "
                "the others were stopped; the same command resumes from the last checkpoint"
            )
        answer: dict[str, Any] | Exception = answers.get()
        if isinstance(answer, Exception):
            raise answer
        return answer
    finally:
        for rank in ranks:
            rank.kill()  # at once: Gloo would print that it lost a peer


def _main(rank: int, work: Work, threads: int, world: int, port: int, answers: "SimpleQueue[Any]") -> None:
    """Do the work of one process; rank 0 answers with its results, each with its error."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C, which the parent reports, and the parent's death
    numbers = {"MASTER_PORT": port, "WORLD_SIZE": world, "NODE_RANK": 0, "RANK": rank, "LOCAL_RANK": rank}
    os.environ.update({"MASTER_ADDR": "127.0.0.1"} | {name: str(number) for name, number in numbers.items()})
    try:
        results = work(threads, rank)
    except Exception as error:
        answers.put(error if isinstance(error, UserError) else _picklable(error, f"rank {rank} of {world}"))
        sys.exit(1)
    if rank == 0:
        answers.put(results)
    if dist.is_initialized():
        dist.destroy_process_group()


def _picklable(error: Exception, where: str) -> RuntimeError:
    fault = RuntimeError(f"{where} failed with {traceback.format_exception_only(error)[-1].strip()}")
    fault.add_note("".join(traceback.format_exception(error)))
    return fault
