"""The card of a run: a Markdown page with figures and their conditions, data, training and use, from its record."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from phd_exp.config import FolderConfig, RenderedConfig, RunConfig
from phd_exp.config.sections import DataConfig
from phd_exp.config.targets import custom_parts
from phd_exp.evaluation.parquet import Arrays, read_table, require_columns
from phd_exp.records.errors import RunError, one_line
from phd_exp.records.runs import RunFolder, RunStatus

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

{conditions}

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


def card(run: RunFolder, config: RunConfig, license: str = UNKNOWN) -> str:
    """The card of a finished run.

    Args:
        run: the record.
        config: its checked configuration.
        license: identifier of the licence, as of SPDX.

    Raises RunError if the results or the predictions of test samples are missing or cannot be read.
    """
    status, results, table = run.status(), run.results(), read_table(run.predictions)
    require_columns(("z",), table)
    if status is None:
        raise RunError(f"{run.status_file}: missing; expected the folder of a finished run")
    given = "No licence is named: ask the author before you use it." if license == UNKNOWN else f"`{license}`"
    return _CARD.format(
        license=license.lower(),
        model=config.model.name,
        data=config.data.name,
        uncertainty=", and a probability density over it" if "level" in table else ", without uncertainty",
        f=round(float(np.median(table["f"]))) if "f" in table else "PIXELS",
        box=" box=LEFT,TOP,RIGHT,BOTTOM" if _is_of_boxes(config) else "",
        trust=_trust(config),
        n=f"{len(table['z']):,}",
        figures="\n".join(_rows(dict(_figures(table)))),
        conditions=_conditions(config),
        law="\n".join(_rows(_law(config.data))),
        training="\n".join(_rows(_training(config, status, results))),
        licence=given,
    )


def _rows(values: Mapping[str, Any]) -> Iterator[str]:
    """Rows of a Markdown table; text from a record cannot end its cell, be HTML, or show an image of a server."""
    for name, value in values.items():
        text = one_line(str(value)).replace("\\", "/").replace("|", "/").replace("<", "(").replace("](", "] (")
        yield f"| {name} | {text} |"


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


def _conditions(config: RunConfig) -> str:
    n = config.data.n_held_out
    held_out = f"`recalibrate=true` and `coverage=0.9` use {n:,} held-out images. " if n else ""
    return (
        "Test images were not used for training and have the distribution of the training images, below. One "
        f"network, seed {config.seed}: the intervals are those of the test images, not of other seeds. As trained, "
        f"without recalibration. {held_out}The projected error is the distance of the estimate from the true viewing "
        "ray, the depth error that along it."
    )


def _is_of_boxes(config: RunConfig) -> bool:
    return isinstance(config.data, FolderConfig) or (
        isinstance(config.data, RenderedConfig) and config.data.spec.is_box
    )


def _trust(config: RunConfig) -> str:
    """How to load a network whose parts are not of this package."""
    packages = {name.partition(".")[0] for name in custom_parts({"head": config.model.head, "net": config.backbone})}
    names = ",".join(sorted(packages))
    return (
        f"\nThe network has parts of other packages: install them and add `trust={names}`, which runs their code.\n"
        if names
        else ""
    )


def _law(data: DataConfig) -> dict[str, Any]:
    """What is known of the images: all of rendered ones, little of the user's own."""
    sizes = f"{data.n_train or 'all'} to train, {data.n_held_out} held out, {data.n_test or 'all'} to test"
    about: dict[str, Any] = {"images": sizes, "seen by the network as": f"{data.image_size} x {data.image_size} px"}
    if not isinstance(data, RenderedConfig):
        return about | {
            "origin": "the author's own images" if isinstance(data, FolderConfig) else "the author's code"
        }
    spec = data.spec
    kept = spec.model_dump(
        mode="json", exclude_defaults=True, exclude={"variant", "seed", "mesh", "camera", "backdrops"}
    )
    origin = "rendered: " + ("an object of the author's mesh" if spec.mesh else "a cylinder")
    return about | {"origin": origin} | {f"data.{key}": _plain(value) for key, value in kept.items()}


def _plain(value: Any) -> Any:
    """A value without the names of files, which are the author's."""
    return (
        f"{len(value)} file(s)"
        if isinstance(value, list) and any(isinstance(one, str | dict) for one in value)
        else value
    )


def _training(config: RunConfig, status: RunStatus, results: Mapping[str, Any]) -> dict[str, Any]:
    backbone = {
        key: value for key, value in config.backbone.items() if not isinstance(value, str) or key == "_target_"
    }
    return {
        "preset, recipe, seed": f"{config.preset}, {config.recipe.name}, {config.seed}",
        "backbone": ", ".join(f"{key}={value}" for key, value in backbone.items()),
        "epochs": results.get("epochs", config.trainer.max_epochs),
        "precision": results.get("precision", "unknown"),
        "device": f"{results.get('device', 'unknown')}, {status.machine}",
        "finished": status.ended.date() if status.ended else "unknown",
        "versions": ", ".join(f"{name} {version}" for name, version in status.versions.items()),
        "git commit": status.git_commit or "unknown",
        "data manifest": status.data_manifest or "none",
    }
