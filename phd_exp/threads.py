"""The number of torch's threads: by default, and where several wait for each other longer than they compute."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


def default_threads(cores: int) -> int:
    """One thread a core, fewer if OMP_NUM_THREADS asks for fewer, as torch does by itself.

    Examples:
        >>> os.environ["OMP_NUM_THREADS"] = "2"
        >>> default_threads(8), default_threads(1)
        (2, 1)
        >>> del os.environ["OMP_NUM_THREADS"]
    """
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0].strip()  # one number for each level of nesting
    return min(cores, int(asked)) if asked.isdecimal() and int(asked) else cores


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread: for many operations on tensors that are too small to share.

    Where other programmes want the cores too, its threads otherwise spin at the end of each operation until the
    slowest has had its turn. On two cores that others used as well, the evaluation of 20 runs took 5 s so and 89 s on
    two threads; fusion took 10 us a problem and 88 us.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
