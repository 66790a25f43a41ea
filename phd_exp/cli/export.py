"""`python -m phd_exp export`: a run's network as an ONNX file, compared with torch."""

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

from pydantic import model_validator

from phd_exp.cli.arguments import Coverage, RunArguments, loaded
from phd_exp.cli.outputs import output_folder, require_file
from phd_exp.records.errors import ConfigError

if TYPE_CHECKING:  # imports of torch, which follow the checks of the arguments
    from phd_exp.data.batches import Batch
    from phd_exp.inference.predictor import Predictor


class ExportArguments(RunArguments):
    """The run and the file; recalibrate=true applies the temperatures fitted on the run's held-out samples."""

    out: Path | None = None
    """the file; by default network.onnx in the (first) run's folder, or next to a file of `pack`"""
    coverage: Coverage = None
    photographs: bool = False
    """the inputs are a photograph, its camera matrix and boxes, and the graph crops as predict does"""
    precision: Literal["float32", "float64"] = "float32"
    """of computations before and after the network, and of the camera and boxes of photographs"""
    quantize: Literal["int8"] | None = None
    """convolutions in int8, calibrated and measured on the run's held-out images; refused if the errors grow"""

    @model_validator(mode="after")
    def one_network(self) -> Self:
        """Refuse a guarantee that was made for another network, and a margin without boxes."""
        if self.quantize and self.coverage:
            raise ValueError("coverage: is guaranteed for the network in float32; expected no quantize=")
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
    require_file(file, "network.onnx")
    predictor = loaded(arguments, "cpu", arguments.coverage)
    output_folder(file.parent)
    from phd_exp.inference.deployed import PHOTOGRAPHS, batches, require_exportable
    from phd_exp.inference.onnx import TOLERANCE, export

    require_exportable(predictor)
    held_out = _held_out(predictor) if arguments.quantize else None
    sizes = [n for _, _, n in PHOTOGRAPHS] if arguments.photographs else batches(predictor.side)
    numbers = ", ".join(map(str, sizes))
    what = f"photographs with {numbers} boxes" if arguments.photographs else f"images in batches of {numbers}"
    if arguments.coverage:
        predictor.guarantee(arguments.coverage)  # is refused, if at all, before the work that is printed
    print(f"{file}: converting the network to ONNX, then comparing it with torch on {what}", flush=True)
    deviation, change = export(
        predictor, file, arguments.coverage, arguments.photographs, arguments.precision, held_out
    )
    print(f"{file}: {file.stat().st_size / 1e6:.1f} MB, {arguments.precision} after the network")
    print(f"  largest relative deviation from torch: {deviation:.1e} (at most {TOLERANCE:g})")
    if change:
        print(f"  int8: {change}")
    return 0


def _held_out(predictor: "Predictor") -> "Batch":
    """The held-out samples of a run. Raises ConfigError for several runs, too few samples, and a source of code."""
    from phd_exp.build import build_source
    from phd_exp.config import SourceConfig
    from phd_exp.inference.onnx_int8 import IMAGES_AT_LEAST

    if predictor.others:
        raise ConfigError(f"quantize: got {len(predictor.networks)} networks; expected a single run")
    data = predictor.config.data
    if isinstance(data, SourceConfig):  # code, which a stored configuration does not run
        raise ConfigError(
            "quantize: got a run on a source of the user's own, whose code is not run here; expected a run on "
            "rendered images or data=folder"
        )
    if data.n_held_out < IMAGES_AT_LEAST:
        raise ConfigError(
            f"quantize: got a run with {data.n_held_out} held-out images; expected at least {IMAGES_AT_LEAST}, on "
            "which int8 is calibrated and measured; train with data.n_held_out=100"
        )
    return build_source(data).samples("held_out")
