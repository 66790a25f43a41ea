"""What computes: torch's threads, the GPU, and the arithmetic that suits both."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from phd_exp.records.processes import cpu_has_bfloat16


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


def has_gpu(accelerator: str) -> bool:
    """Whether a run with this `trainer.accelerator` trains on a GPU."""
    return accelerator != "cpu" and torch.cuda.is_available()


def precision(accelerator: str, asked: str) -> Any:
    """Lightning's name of the arithmetic of `trainer.precision`: bfloat16 autocast on hardware with bfloat16 units.

    Without such units bfloat16 is three times slower than float32 on a CPU (resnet18, 112 px).
    """
    fast = torch.cuda.is_bf16_supported(including_emulation=False) if has_gpu(accelerator) else cpu_has_bfloat16()
    return "bf16-mixed" if asked == "bfloat16" or (asked == "auto" and fast) else "32-true"
