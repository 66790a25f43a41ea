"""A bad input, and the words of the commands that meet one."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tests.bad_input.place import HANDMADE, TRAIN, Place

RUN = "run=RUN"
"""The run of the place, whose name holds a hash."""
PREDICT = ("predict", RUN, "folder=photos/test")
ONE = ("predict", RUN, "image=photos/test/0.png", "f=300")
EXPORT = ("export", RUN)
REPORT = ("report", "runs=runs")
LEARN = (*TRAIN, "data.folder=photos")
VERIFY = ("render", *HANDMADE, "verify=true", "rerender=0")
LEARN_HANDMADE = (
    *HANDMADE, "logger=none", "data.n_train=1", "data.n_held_out=1", "data.n_test=2", "data.batch_size=1",
)  # fmt: skip


@dataclass(frozen=True)
class Bad:
    """A bad input.

    Attributes:
        name: what is wrong.
        spoil: makes it so.
        words: of the command line.
        said: the whole line after `error: `, as a regular expression.
        status: the exit status.
    """

    name: str
    spoil: Callable[[Place], Any]
    words: tuple[str, ...]
    said: str
    status: int = 1
