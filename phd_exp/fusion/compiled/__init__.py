"""Fusion on a CPU: one problem after the other on each core, compiled, which is what a CPU is best at.

Operations on whole batches spend a CPU's time on launching themselves and on moving what lies between them; a problem
of a few cameras fits into a core's cache. With a GPU it is the other way round: there the modules of `phd_exp.fusion`
serve. Each module here has the formulas, constants and stopping rules of the one there of the same name, and none of
its own; tests/fusion/test_compiled.py holds the two against each other.

Arrays have the problems first: slope (problems, cameras, 3, 3), at_origin (problems, cameras, 3), a (problems,
cameras), u (problems, 3); on a plane nothing depends on the third unknown. What is compiled takes its types from what
it is given; checks of annotations would keep it from being compiled. Divisions by zero are
infinite, as they are elsewhere.
"""

from pathlib import Path

from numba import njit


def _forget_what_is_stale() -> None:
    """Let nothing be used that was compiled before a source changed; numba looks at a function's own file alone."""
    here = Path(__file__).parent
    sources = [*here.parent.rglob("*.py"), *here.parents[1].glob("distributions/*.py")]
    changed = max(source.stat().st_mtime for source in sources)
    for index in (here / "__pycache__").glob("*.nbi"):
        if index.stat().st_mtime < changed:
            index.unlink(missing_ok=True)


_forget_what_is_stale()
compiled = njit(cache=True, error_model="numpy")
on_all_cores = njit(cache=True, error_model="numpy", parallel=True)
