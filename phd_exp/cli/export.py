"""`python -m phd_exp export`: a run's network as an ONNX file, checked against torch."""

from importlib.util import find_spec
from pathlib import Path

from phd_exp.cli.arguments import Arguments, output_folder, parsed, say_if_unfinished
from phd_exp.records.errors import ConfigError

NEEDED = ("onnx", "onnxscript", "onnxruntime")


class ExportArguments(Arguments):
    """Which run, and where to; with recalibrate=true at the temperatures that fit its held-out samples."""

    run: Path
    out: Path | None = None
    recalibrate: bool = False


def main(words: list[str]) -> int:
    """Export as the words say; returns the exit status."""
    arguments = parsed("export", ExportArguments, words)
    _export(arguments, arguments.out or arguments.run / "network.onnx")
    return 0


def _export(arguments: ExportArguments, file: Path) -> None:
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise ConfigError(f"export needs {', '.join(missing)}: `pip install 'phd_exp[export]'`")
    if file.is_dir():
        raise ConfigError(f"out={file}: is a folder; expected a file, such as {file / 'network.onnx'}")
    from phd_exp.inference.predictor import load  # seconds of imports, which a mistake need not wait for

    predictor = load(arguments.run, device="cpu", recalibrate=arguments.recalibrate)
    say_if_unfinished(arguments.run, predictor.state)
    output_folder(file.parent)
    from phd_exp.inference.onnx import CHECKED, TOLERANCE, export

    deviation = export(predictor, file)
    print(f"{file}: {file.stat().st_size / 1e6:.1f} MB")
    print(
        f"  largest relative deviation from torch over {sum(CHECKED)} images, in batches of "
        f"{', '.join(map(str, CHECKED))}: {deviation:.1e} (at most {TOLERANCE:g})"
    )
