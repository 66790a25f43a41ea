"""Torch's threads, where several of them wait for each other longer than they compute."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


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
