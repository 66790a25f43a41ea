"""Commands in processes of their own, which may be killed, or end amid a write."""

import multiprocessing
import os
import signal
from itertools import count
from multiprocessing.process import BaseProcess
from typing import Any

from phd_exp.__main__ import main


def begin(words: list[str], preload: list[str], torn: int = 0) -> BaseProcess:
    """A command in a process that is forked from one that has imported these modules already.

    It is killed when it has written file number `torn` (from 1) but not yet renamed it into place; 0: never.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(preload)
    process = context.Process(target=_run, args=(words, torn))
    process.start()
    return process


def _run(words: list[str], torn: int) -> None:
    replace, number = os.replace, count(1)

    def counted(*places: Any) -> None:
        if str(places[0]).endswith(".tmp") and next(number) == torn:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(*places)

    os.replace = counted  # type: ignore[assignment]
    main(words)
