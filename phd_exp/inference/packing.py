"""A run as one file that others predict with, see `records.packed`, and its card: a page from the run's record."""

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from phd_exp.config import FolderConfig, RenderedConfig, RunConfig, check
from phd_exp.config.sections import DataConfig
from phd_exp.config.targets import Trust, custom_parts
from phd_exp.evaluation.parquet import Arrays, read_table, require_columns
from phd_exp.models.weights import WEIGHTS as PREFIX
from phd_exp.models.weights import regressor_weights
from phd_exp.records.errors import RunError, one_line
from phd_exp.records.files import read_plain
from phd_exp.records.packed import CARD, LARGEST, WEIGHTS, recorded_files, write_packed
from phd_exp.records.runs import RunFolder

UNKNOWN = "unknown"  # a licence that nobody has named
MEANS = {
    "projected_error_mm": "projected error, mm",
    "depth_error_mm": "depth error, mm",
    "relative_error": "distance between estimate and truth over the truth's distance, %",
    "nll": "negative log-likelihood, nats",
    "depth_crps": "CRPS of depth, m",
}
"""Column of the recorded predictions -> what its mean is."""
PER_CENT = (50, 90, 99)
NORMAL = 1.96  # standard errors to either end of a 95 % interval

_CARD = """\
---
license: {license}
library_name: phd_exp
tags: [position-estimation, uncertainty, {data}]
---

# {model} on {data}

A network that estimates the 3-D position of an object in one image{uncertainty}. Written by `phd_exp pack` from the
record of the run, without new computations.

## Use

    pip install phd_exp
    python -m phd_exp predict run=run.zip image=photo.jpg f={f}{box}

`f` is the focal length in pixels of the image file. The same from Python, with images as uint8 (n, height, width, 3):

    phd_exp.load("run.zip")(images, f={f})
{trust}
## Figures

| on {n} test images | mean ± 95 % interval |
|---|---:|
{figures}

Test images were not used for training and have the distribution of the training images, below. One network, seed
{seed}: the intervals are those of the test images, not of other seeds. As trained, without recalibration.
{held_out}The projected error is the distance of the estimate from the true ray, the depth error that along the ray.

## Data

| | |
|---|---|
{law}

Images and cameras unlike these are extrapolation. `familiar` below 0.05 in an answer marks predictions that are
unusual among those of held-out images; a covariance alone does not.

## Training

| | |
|---|---|
{training}

## Licence

{licence}
"""


def pack(run: RunFolder, out: Path, license: str = UNKNOWN, trust: Trust = ()) -> dict[str, int]:
    """Write a finished run as an archive; returns the bytes of each of its files by name.

    Of the checkpoint that is evaluated, it holds the weights of the network and nothing else.

    Raises RunError for a run that is not finished or whose record cannot be read, ConfigError for a configuration
    that is invalid or names code that is not trusted.
    """
    if not run.path.is_dir() or not run.is_finished():
        raise RunError(f"{run.path}: expected the folder of a finished run")
    checkpoint = run.best_checkpoint
    if checkpoint.is_symlink() or run.checkpoints.is_symlink():
        raise RunError(f"{checkpoint}: is a link; put the file or folder itself in its place")
    contents = {CARD: card(run, check(run.config(), trust), license).encode(), WEIGHTS: _weights(checkpoint)}
    for name, path in recorded_files(run):
        contents[name] = read_plain(path, LARGEST)
    write_packed(out, contents)
    return {name: len(content) for name, content in contents.items()}


def _weights(checkpoint: Path) -> bytes:
    """A checkpoint with the weights of the network alone: no states of optimizers, no paths."""
    weights = {f"{PREFIX}{name}": value.clone() for name, value in regressor_weights(checkpoint).items()}
    stream = io.BytesIO()
    torch.save({"state_dict": weights}, stream)
    return stream.getvalue()


def card(run: RunFolder, config: RunConfig, license: str = UNKNOWN) -> str:
    """The card of a finished run, in Markdown; `license` is an identifier as of SPDX.

    Raises RunError if the results or the predictions of test samples are missing or cannot be read.
    """
    table, data, n_held_out = read_table(run.predictions), config.data, config.data.n_held_out
    require_columns(("z",), table)
    has_boxes = data.spec.is_box if isinstance(data, RenderedConfig) else isinstance(data, FolderConfig)
    packages = {name.partition(".")[0] for name in custom_parts({"head": config.model.head, "net": config.backbone})}
    trust = f"install them and add `trust={','.join(sorted(packages))}`, which runs their code."
    held_out = f"`recalibrate=true` and `coverage=0.9` use {n_held_out:,} held-out images. "
    return _CARD.format(
        license=license.lower(),
        model=config.model.name,
        data=data.name,
        uncertainty=", and a probability density over it" if "level" in table else ", without uncertainty",
        f=round(float(np.median(table["f"]))) if "f" in table else "PIXELS",
        box=" box=LEFT,TOP,RIGHT,BOTTOM" if has_boxes else "",
        trust=f"\nThe network has parts of other packages: {trust}\n" if packages else "",
        n=f"{len(table['z']):,}",
        figures=_rows(dict(_figures(table))),
        seed=config.seed,
        held_out=held_out if n_held_out else "",
        law=_rows(_law(data)),
        training=_rows(_training(run, config)),
        licence="No licence is named: ask the author before you use it." if license == UNKNOWN else f"`{license}`",
    )


def _rows(values: Mapping[str, Any]) -> str:
    """Rows of a Markdown table; text from a record cannot end its cell, be HTML, or show an image of a server."""
    texts = {name: one_line(str(value)).replace("\\", "/").replace("|", "/") for name, value in values.items()}
    return "\n".join(f"| {name} | {text.replace('<', '(').replace('](', '] (')} |" for name, text in texts.items())


def _figures(table: Arrays) -> Iterator[tuple[str, str]]:
    """Means over test samples with 1.96 standard errors, and shares of truths inside credible regions."""
    for column, words in MEANS.items():
        if column in table:
            values = table[column]
            half = NORMAL * values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
            yield words, f"{values.mean():.4g} ± {half:.2g}"
    for level in PER_CENT if "level" in table else ():
        share = np.mean(table["level"] <= level / 100)
        half = NORMAL * np.sqrt(share * (1 - share) / len(table["level"]))
        yield f"truths inside the {level} % credible region, %", f"{100 * share:.1f} ± {100 * half:.1f}"


def _law(data: DataConfig) -> dict[str, Any]:
    """What is known of the images: all of rendered ones, little of the user's own, and no names of files."""
    sizes = f"{data.n_train or 'all'} to train, {data.n_held_out} held out, {data.n_test or 'all'} to test"
    about: dict[str, Any] = {"images": sizes, "seen by the network as": f"{data.image_size} x {data.image_size} px"}
    if not isinstance(data, RenderedConfig):
        return about | {
            "origin": "the author's own images" if isinstance(data, FolderConfig) else "the author's code"
        }
    left_out = {"variant", "seed", "mesh", "camera", "backdrops"}
    kept = data.spec.model_dump(mode="json", exclude_defaults=True, exclude=left_out)
    about["origin"] = "rendered: " + ("an object of the author's mesh" if data.spec.mesh else "a cylinder")
    for key, value in kept.items():
        has_names = isinstance(value, list) and any(isinstance(one, str | dict) for one in value)
        about[f"data.{key}"] = f"{len(value)} file(s)" if has_names else value
    return about


def _training(run: RunFolder, config: RunConfig) -> dict[str, Any]:
    """How the network was trained. Raises RunError without the run's status."""
    status, results = run.status(), run.results()
    if status is None:
        raise RunError(f"{run.status_file}: missing; expected the folder of a finished run")
    backbone = [
        f"{key}={value}" for key, value in config.backbone.items() if not isinstance(value, str) or key == "_target_"
    ]
    return {
        "preset, recipe, seed": f"{config.preset}, {config.recipe.name}, {config.seed}",
        "backbone": ", ".join(backbone),
        "epochs": results.get("epochs", config.trainer.max_epochs),
        "precision": results.get("precision", "unknown"),
        "device": f"{results.get('device', 'unknown')}, {status.machine}",
        "finished": status.ended.date() if status.ended else "unknown",
        "versions": ", ".join(f"{name} {version}" for name, version in status.versions.items()),
        "git commit": status.git_commit or "unknown",
        "data manifest": status.data_manifest or "none",
    }
