"""Fusion on a CPU: one problem after the other on each core, compiled, which is what a CPU is best at.

Operations on whole batches spend a CPU's time on launching themselves and on moving what lies between them; a problem
of a few cameras fits into a core's cache. With a GPU it is the other way round: there the modules of `phd_exp.fusion`
serve. Each module here has the formulas, constants and stopping rules of the one there of the same name, but that
`polish` leaves off where nothing moves; tests/fusion/test_compiled.py holds the two against each other.

Arrays have the problems first: slope (problems, cameras, 3, 3), at_origin (problems, cameras, 3), a (problems,
cameras), u (problems, 3); on a plane nothing depends on the third unknown. What is compiled takes its types from what
it is given; checks of annotations would keep it from being compiled. Divisions by zero are infinite, as elsewhere.
"""

import hashlib
from contextlib import suppress
from pathlib import Path

import numpy as np
from numba import njit

from phd_exp.records.files import write_atomic


def _forget_what_is_stale(package: Path) -> None:
    """Let nothing be used that was compiled of other sources; numba looks at a function's own file alone."""
    here = package / "fusion" / "compiled"
    sources = sorted([*(package / "fusion").rglob("*.py"), *(package / "distributions").rglob("*.py")])
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()
    stamp = here / "__pycache__" / "sources.sha256"
    if stamp.exists() and stamp.read_text() == digest:
        return
    with suppress(OSError):  # in a folder that cannot be written numba keeps nothing either
        for index in stamp.parent.glob("*.nbi"):
            index.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        write_atomic(stamp, digest)


TINY = float(np.finfo(np.float64).tiny)
_forget_what_is_stale(Path(__file__).parents[2])
compiled = njit(cache=True, error_model="numpy")
on_all_cores = njit(cache=True, error_model="numpy", parallel=True)
