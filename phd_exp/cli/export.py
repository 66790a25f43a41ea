"""`python -m phd_exp export`: a run's network as an ONNX file, compared with torch."""

from importlib.util import find_spec
from pathlib import Path
from typing import Literal, Self

from pydantic import model_validator

from phd_exp.cli.arguments import Coverage, RunArguments, loaded
from phd_exp.cli.outputs import output_folder, require_output
from phd_exp.records.errors import ConfigError


class ExportArguments(RunArguments):
    """The run and the file; recalibrate=true applies the temperatures fitted on the run's held-out samples."""

    out: Path | None = None
    """the file; by default network.onnx in the (first) run's folder, or next to a file of `pack`"""
    coverage: Coverage = None
    photographs: bool = False
    """the inputs are a photograph, its camera matrix and boxes, and the graph crops as predict does"""
    precision: Literal["float32", "float64"] = "float32"
    """of computations before and after the network, and of the camera and boxes of photographs"""

    @model_validator(mode="after")
    def margin_has_boxes(self) -> Self:
        """Refuse a margin without boxes."""
        if self.margin != 1 and not self.photographs:
            raise ValueError("margin: enlarges boxes; expected photographs=true too")
        return self


def main(words: list[str]) -> int:
    """Export the network of a run; returns the exit status."""
    arguments = ExportArguments.parsed("export", words)
    run = arguments.run[0]
    file = arguments.out or (run.with_suffix(".onnx") if run.is_file() else run / "network.onnx")
    if missing := [name for name in ("onnx", "onnxscript", "onnxruntime") if find_spec(name) is None]:
        raise ConfigError(f"export needs {', '.join(missing)}: `pip install 'phd_exp[export]'`")
    require_output(file, "network.onnx", arguments)
    predictor = loaded(arguments, "cpu", arguments.coverage)
    output_folder(file.parent)
    from phd_exp.inference.deployed import PHOTOGRAPHS, batches, require_exportable
    from phd_exp.inference.onnx import TOLERANCE, export

    require_exportable(predictor)
    sizes = [n for _, _, n in PHOTOGRAPHS] if arguments.photographs else batches(predictor.side)
    numbers = ", ".join(map(str, sizes))
    what = f"photographs with {numbers} boxes" if arguments.photographs else f"images in batches of {numbers}"
    if arguments.coverage:
        predictor.guarantee(arguments.coverage)  # is refused, if at all, before the work that is printed
    print(f"{file}: converting the network to ONNX, then comparing it with torch on {what}", flush=True)
    deviation = export(predictor, file, arguments.coverage, arguments.photographs, arguments.precision)
    print(f"{file}: {file.stat().st_size / 1e6:.1f} MB, {arguments.precision} after the network")
    print(f"  largest relative deviation from torch: {deviation:.1e} (at most {TOLERANCE:g})")
    return 0
