"""All kinds of tables except the paper's, described as data: headings, groups, columns of CSV, explanations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from phd_exp.reports.table import Table, file_stem, pivot

WANTED, LEAST = 90, 80  # per cent inside the 90 % region: of a calibrated run, and below which the promise is broken


@dataclass(frozen=True)
class Kind:
    """What all tables of a kind have in common.

    Attributes:
        csv: columns of its CSV file, as `name` or `name=column`.
        stub: headings of the labels, likewise.
        group: the column whose values have a rule between them.
        below: the meaning of the cells' second lines.
    """

    csv: str
    stub: str
    group: str
    notes: tuple[str, ...]
    below: str = ""

    def table(
        self, kind: str, names: Sequence[str], found: pd.DataFrame, title: str, shown: pd.DataFrame | None = None,
        **more: Any,
    ) -> Table:  # fmt: skip
        """The table of the rows `shown`, with the columns `heading` and `cell`; all rows found are lines of CSV.

        Rows without a cell are not shown.
        """
        stub = _columns(self.stub)
        shown = found if shown is None else shown
        shown = shown[shown["cell"].notna()].astype(dict.fromkeys(stub.values(), str))
        columns, groups = pivot(shown, list(stub.values()), "heading", self.group)
        headings = tuple(heading.replace("_", " ") for heading in stub)
        given = {"notes": self.notes, "below": self.below, "lines": chosen(found, self.csv)} | more
        return Table(file_stem(kind, *names), kind, title, headings, columns, groups, **given)


def chosen(found: pd.DataFrame, csv: str) -> pd.DataFrame:
    """Columns by their names in a CSV file, `name` or `name=column`."""
    columns = _columns(csv)
    return found[list(columns.values())].set_axis(list(columns), axis=1)


def _columns(text: str) -> dict[str, str]:
    pairs = (one.partition("=") for one in text.split())
    return {name: column or name for name, _, column in pairs}


OF_THE_DETAILS = "In brackets: 95 % bootstrap intervals over test samples. Home: the unchanged test samples."
OF_SCENES = "In brackets: 95 % bootstrap intervals over"
KINDS: Mapping[str, Kind] = {
    "heads": Kind(
        "preset data model overrides=digest seed quantity value difference low high better",
        "model breaks seeds",
        "preset",
        (
            "A cell: the mean over seeds with its 95 % interval, over seeds (Student's t) and test samples; below "
            "it the difference to the probabilistic model with its 95 % interval, by a paired t-test over seeds. "
            "Bold: better than the probabilistic model by that test, corrected for the number of comparisons in "
            "the table (Holm, 5 %); never one seed or coverage. Breaks: the constraints that the head violates, "
            "of the paper's seven.",
        ),
        "difference",
    ),
    "calibration": Kind(
        "preset data model run predictions=method quantity value calibrated low high",
        "run=label",
        "path",
        (
            "A cell: the score of the run's predictions; below it the 95 % interval of calibrated predictions "
            "with the same uncertainties (truths simulated from them). Finitely many samples never give zero: a "
            "value outside that interval (↑, ↓) is miscalibrated, a value inside it is not distinguishable from "
            "calibrated. Coverage and CRPS: calibration.csv.",
        ),
        "calibrated",
    ),
    "ensembles": Kind(
        "preset data model overrides=digest prediction=method quantity value low high",
        "runs=label prediction=method",
        "label",
        (
            "One network: the mean over the seeds. Seeds: the Projected Huber distribution closest to the mixture "
            "of the first ones; eight views: the same for one network's predictions of turned and mirrored "
            "images. Inside 90 %: per cent of true positions in the 90 % region; mean level: 0.5 if calibrated, "
            "more if overconfident. In brackets: 95 % bootstrap intervals over test images.",
        ),
    ),
    "shifts": Kind(
        "preset data model run camera axis shift=subject n left_out quantity value low high",
        "trained_on,_camera=label run",
        "data",
        (
            f"Per cent of truths inside the predicted 90 % region. Arrow: the 95 % interval excludes {WANTED} %; "
            f"two: fewer than {LEAST} % are inside. Home: the unchanged test samples. The files and the site have "
            "all scores.",
        ),
        "95 %",
    ),
    "variations": Kind(
        "preset data model overrides=words seed quantity value",
        "overrides=label seeds=of",
        "is_varied",
        (
            "Held-out images: of the training split, never trained on, over the whole field of view. A number is "
            "the mean over seeds with its 95 % interval, over seeds (Student's t) and images. Errors: of the "
            "mode. Difference: of the NLL, or of a model without one of the depth error, to the runs of the same "
            "seeds without overrides, by a paired t-test; negative is better.",
        ),
    ),
    "fusion": Kind(
        "preset data model run quantity method cameras ground mean=value low high exact n_scenes=n",
        "quantity=label method=way",
        "label",
        (
            "Columns: number of cameras of each scene that are fused, starting with the first. Depth: the error "
            "along the first camera's true viewing ray, as in the paper's tables; distance: in space; both means "
            f"over scenes. {OF_SCENES} scenes.",
            "Huber: the most likely position under the product of the views' Projected Huber densities, and the "
            "mean of that product. Shared: the mean where all views' depths share an unknown factor, as much as "
            "in the other half of the scenes. Average: of the views' modes. Gaussian: the views' means weighted "
            "by their inverse covariances.",
            "Ground: every position is also known to lie on a plane through the true one with the normal (0, cos "
            "30°, sin 30°) in the first camera's frame, the ground in front of a camera that looks down by 30°. "
            "The average is moved to the nearest point of the plane, the Gaussian is conditioned on it.",
            "Inside 50, 90, 99 %: per cent of true positions in the ellipsoids of mean and covariance that "
            "contain as much of a Gaussian; below it the share that exact densities have there, whose tails are "
            "longer. Squared error over predicted: the squared Mahalanobis distance per dimension, 1 on average "
            "where calibrated, above 1 where overconfident.",
        ),
        "exact densities",
    ),
    "tracks": Kind(
        "preset data model run frames cameras quantity method mean=value low high n_sequences=n n_hidden",
        "quantity=label method=way",
        "label",
        (
            f"Means over the frames of all sequences. {OF_SCENES} sequences. Depth: along the camera's true "
            "viewing ray; projected: across it, as in the paper's tables. Hidden: frames in which less than {100 "
            "* HIDDEN:.0f} % of the object is visible. Ratios are those of mean errors. Squared error over "
            "predicted: the squared Mahalanobis distance per dimension, averaged over the path, 1 where "
            "calibrated, above 1 where overconfident.",
            "Single frames: the mode of each; with two cameras, the position fused from both. Kalman (RTS): a "
            "Rauch-Tung-Striebel smoother of the frames' means and covariances. Ours: the mean path under the "
            "frames' densities; weighted frames: each density has a weight, the information that neighbouring "
            "frames lack. All assume a velocity that changes by white noise.",
        ),
    ),
    "searches": Kind(
        "search trial state value overrides run",
        "trial overrides",
        "search",
        (
            "Searches minimise a score on held-out samples, which are never trained on; test samples choose "
            "nothing. In the CSV file, the value of a pruned trial is that of its last epoch.",
        ),
    ),
}
BREAKS: Mapping[str, str] = {
    "gaussian": "3, 6",
    "gaussian_mixture": "3, 5, 6",
    "student_t": "3, 5, 6",
    "decomposed": "5",
}
"""Model -> the constraints that its head violates; tests/distributions/test_constraints.py measures them."""
