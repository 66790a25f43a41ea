"""`python -m phd_exp pack`: a run as one file for others, with a card."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from phd_exp.cli.arguments import Arguments, Trust, trusted
from phd_exp.cli.outputs import output_folder, require_output
from phd_exp.records.runs import RunFolder


class PackArguments(Arguments):
    """The run, the file, and the licence for the card."""

    run: Path
    """the folder of a finished run"""
    out: Path | None = None
    """the file; by default run.zip in the run's folder"""
    license: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9.+-]{0,99}$")] = "unknown"
    """identifier of the licence that you give the weights, such as CC-BY-4.0, for the card"""
    trust: Trust = None


def main(words: list[str]) -> int:
    """Pack a run; returns the exit status."""
    arguments = PackArguments.parsed("pack", words)
    out = arguments.out or arguments.run / "run.zip"
    if arguments.run.is_dir():
        require_output(out, "run.zip", arguments)
        output_folder(out.parent)
    from phd_exp.inference.packing import pack

    sizes = pack(RunFolder(arguments.run), out, arguments.license, trusted(arguments.trust))
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {len(sizes)} files; README.md in it is the card")
    print(f"  use it: python -m phd_exp predict run={out} image=photo.jpg f=PIXELS")
    return 0
