"""`python -m phd_exp.training.rank DESCRIPTOR`: one of the processes that train a run together (`ranks.py`)."""

import os
import signal
import sys
import threading
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection

import torch.distributed as dist

from phd_exp.records.errors import UserError
from phd_exp.records.runs import RunFolder
from phd_exp.training.ranks import Report, Share
from phd_exp.training.run import run


def main() -> None:
    """Take a share of a training from the process that started this one, and report how it ended."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches all processes; the one that started us decides
    connection = Connection(int(sys.argv[1]))
    share: Share = connection.recv()
    threading.Thread(target=_end_with, args=(connection,), daemon=True).start()
    connection.send(_report(share))
    if dist.is_initialized():
        dist.destroy_process_group()


def _report(share: Share) -> Report:
    try:
        return Report(run(share.config, RunFolder(share.folder), share.draw, share.threads, share.rank))
    except UserError as error:
        return Report(error=error)
    except Exception:
        return Report(fault=traceback.format_exc())


def _end_with(connection: Connection) -> None:
    """End this process at once when the one that started it is gone: nothing else comes through this connection."""
    with suppress(EOFError, OSError):
        connection.recv()
    os._exit(1)


if __name__ == "__main__":
    main()
