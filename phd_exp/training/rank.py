"""One of several processes that train a run; `ranks.py` starts them.

It exits when the connection to its parent closes, and so when its parent dies.
"""

import os
import sys
import threading
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import torch.distributed as dist

from phd_exp.records.errors import UserError
from phd_exp.records.processes import parent
from phd_exp.records.runs import RunFolder
from phd_exp.training.ranks import Share


def main() -> None:
    """Train, and send back the results or the error."""
    connection = parent()
    sys.path.append(os.getcwd())  # for the user's own parts
    share: Share = connection.recv()
    threading.Thread(target=_exit_with_parent, args=(connection,), daemon=True).start()
    connection.send(_outcome(share))
    if dist.is_initialized():
        dist.destroy_process_group()


def _outcome(share: Share) -> dict[str, Any] | Exception:
    from phd_exp.training.run import run  # imports of seconds, in which the parent may die

    config, folder, draw, threads, rank = share
    try:
        return run(config, RunFolder(folder), draw, threads, rank)
    except UserError as error:
        return error
    except Exception as error:  # it may not pickle, its traceback does
        last = traceback.format_exception_only(error)[-1].strip()
        fault = RuntimeError(f"rank {rank} of {config.trainer.devices} failed with {last}")
        fault.add_note(traceback.format_exc())
        return fault


def _exit_with_parent(connection: Connection) -> None:
    """Exit at once when the connection closes; nothing else arrives through it."""
    with suppress(EOFError, OSError):
        connection.recv()
    os._exit(1)


if __name__ == "__main__":
    main()
