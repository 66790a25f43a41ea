"""Execute notebooks in the root of the checkout and keep their outputs, without a trace of when and where.

    python notebooks/execute.py                            all of them
    python notebooks/execute.py notebooks/02_renders.ipynb

Data sets and runs that are missing are made; `PHD_EXP_PRESET` (small, if unset) says of which size. A notebook that
needs photographs is left out unless `PHD_EXP_PHOTOGRAPHS` or the folder `photographs` has them.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent
PHOTOGRAPHS = "PHD_EXP_PHOTOGRAPHS"
KERNEL = {"display_name": "Python 3", "language": "python", "name": "python3"}


def execute(notebook: nbformat.NotebookNode, folder: Path) -> None:
    """Run every cell in a folder and put what it gives in place of its outputs, progress and warnings left out.

    Raises nbclient's CellExecutionError, which names the cell and holds its traceback, where one fails.
    """
    client = NotebookClient(
        notebook,
        timeout=None,
        kernel_name=KERNEL["name"],
        record_timing=False,
        coalesce_streams=True,
        resources={"metadata": {"path": str(folder)}},
    )
    manager = client.create_kernel_manager()
    with tempfile.TemporaryDirectory() as sockets:  # of files, since others on the machine could reach ports
        manager.transport, manager.ip = "ipc", f"{sockets}/kernel"
        client.execute()
    notebook.metadata = nbformat.from_dict({"kernelspec": KERNEL, "language_info": {"name": "python"}})
    for place, cell in enumerate(notebook.cells):
        cell.id, cell.metadata = f"cell-{place:02d}", nbformat.from_dict({})
        if "outputs" in cell:
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]


def is_possible(file: Path) -> bool:
    """Whether the photographs that a notebook may need are there."""
    photographs = os.environ.get(PHOTOGRAPHS, HERE.parent / "photographs")
    return PHOTOGRAPHS not in file.read_text() or Path(photographs).exists()


def main(words: list[str]) -> None:
    for file in map(Path, words) if words else sorted(HERE.glob("*.ipynb")):
        if not is_possible(file):
            print(f"{file.name}: left out, without photographs")
            continue
        began = time.monotonic()
        notebook = nbformat.read(file, as_version=4)
        execute(notebook, HERE.parent)
        nbformat.write(notebook, file)
        print(f"{file.name}: {len(notebook.cells)} cells, {time.monotonic() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
