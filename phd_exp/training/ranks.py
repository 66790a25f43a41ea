"""One task in several processes, which end together.

Lightning would start the command of this process again, which in a sweep is the whole sweep. Here each process is a
`Child` that runs this module, whatever launcher runs the job. It exits when the connection to its parent closes, and
so when its parent dies.
"""

import os
import socket
import sys
import threading
import traceback
from collections.abc import Callable
from contextlib import ExitStack, suppress
from multiprocessing.connection import Connection, wait
from typing import Any

import torch.distributed as dist

from phd_exp.records.errors import RunError, UserError
from phd_exp.records.processes import Child, parent

Work = Callable[[int, int], dict[str, Any]]
"""Number of threads and rank -> results. It is sent to each process, so it must pickle."""


def together(work: Work, world: int, threads: int) -> dict[str, Any]:
    """Do the work in `world` processes, which share the threads; returns the results of rank 0.

    Raises the error of the first process to fail; the others are ended.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": str(world), "NODE_RANK": "0"}
    results: dict[int, dict[str, Any]] = {}
    with ExitStack() as stack:
        ranks: dict[Any, tuple[int, Child]] = {}
        for rank in range(world):
            of_rank = environment | {"RANK": str(rank), "LOCAL_RANK": str(rank)}
            child = stack.enter_context(Child("phd_exp.training.ranks", of_rank))
            child.send((work, max(1, threads // world), rank, world))
            ranks[child.connection] = (rank, child)
        try:
            while ranks:
                for connection in wait(list(ranks)):
                    rank, child = ranks.pop(connection)
                    results[rank] = _received(child, rank, world)
        except RuntimeError:
            # the peer of a killed process fails too, and on a busy machine both are noticed at once
            for rank, child in ranks.values():
                if child.was_killed():
                    _received(child, rank, world)
            raise
        finally:
            for _, child in ranks.values():
                child.process.kill()  # at once: Gloo would print that it lost a peer
    return results[0]


def _received(child: Child, rank: int, world: int) -> dict[str, Any]:
    """The results of a process. Raises its error, or RunError if it ended without one."""
    try:
        results: dict[str, Any] = child.receive()
    except EOFError as death:
        raise RunError(
            f"rank {rank} of {world}: {death}; the others were stopped; the same command resumes from the last "
            "checkpoint"
        ) from None
    return results


def main() -> None:
    """Do the work of one process, and send back the results or the error."""
    connection = parent()
    sys.path.append(os.getcwd())  # for the user's own parts
    share = connection.recv()
    threading.Thread(target=_exit_with_parent, args=(connection,), daemon=True).start()
    connection.send(_outcome(*share))
    if dist.is_initialized():
        dist.destroy_process_group()


def _outcome(work: Work, threads: int, rank: int, world: int) -> dict[str, Any] | Exception:
    try:
        return work(threads, rank)
    except UserError as error:
        return error
    except Exception as error:  # it may not pickle, its traceback does
        last = traceback.format_exception_only(error)[-1].strip()
        fault = RuntimeError(f"rank {rank} of {world} failed with {last}")
        fault.add_note(traceback.format_exc())
        return fault


def _exit_with_parent(connection: Connection) -> None:
    """Exit at once when the connection closes; nothing else arrives through it."""
    with suppress(EOFError, OSError):
        connection.recv()
    os._exit(1)


if __name__ == "__main__":
    main()
