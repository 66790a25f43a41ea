"""The numbers of a report: their names, units, digits, meanings and best values."""

import math
from dataclasses import dataclass

from phd_exp.metrics.bootstrap import Interval

NOTHING = "–"


@dataclass(frozen=True)
class Quantity:
    """A number of a run.

    Attributes:
        label: its name in words.
        unit: empty if it has none.
        digits: after the decimal point.
        means: its meaning, one line.
    """

    label: str
    unit: str
    digits: int
    means: str

    @property
    def axis(self) -> str:
        """Label and unit, for an axis or a heading."""
        return f"{self.label} ({self.unit})" if self.unit else self.label

    def text(self, value: float | None) -> str:
        """A value with its digits; a dash if it is missing or not finite; from 100 mm on, whole millimetres.

        Examples:
            >>> SCORES["depth_error_mm"].text(47.96), SCORES["depth_error_mm"].text(347.96)
            ('48.0', '348')
        """
        if value is None or not math.isfinite(value):
            return NOTHING
        return f"{value:.{self.digits_of(value)}f}".replace("-", "−")

    def digits_of(self, value: float) -> int:
        """The digits with which a value is shown."""
        return 0 if self.unit == "mm" and abs(value) >= 100 else self.digits

    def signed(self, value: float) -> str:
        """A difference with its sign."""
        return f"{'+' if value > 0 else ''}{self.text(value)}"

    def band(self, low: float, high: float) -> str:
        """An interval in round brackets.

        Examples:
            >>> SCORES["nll"].band(-2, 1.5)
            '(−2.00 to 1.50)'
        """
        return f"({self.text(low)}{'–' if low >= 0 else ' to '}{self.text(high)})"

    def half(self, value: float, low: float, high: float) -> str:
        """Half the width of a symmetric interval, such as `±3`, with the digits of the value; empty without one."""
        return f"±{(high - low) / 2:.{self.digits_of(value)}f}" if math.isfinite(high - low) else ""


def mark(value: float, calibrated: Interval[float] | None) -> str:
    """An arrow for a value above or below the interval of a calibrated model; empty inside it, or without one.

    Examples:
        >>> [mark(value, Interval(0.02, 0.01, 0.04)) for value in (0.005, 0.03, 0.2)]
        ['↓', '', '↑']
    """
    if calibrated is None or calibrated.low <= value <= calibrated.high:
        return ""
    return "↑" if value > calibrated.high else "↓"


_RISK = "mean error of the predictions kept when the least certain are dropped first, averaged over the share kept"
_EXCESS = "0 if predicted variance ranks the errors perfectly, 1 if no better than chance"
_WORST_GROUP = "largest mean gap between coverage and diagonal in groups of samples with similar predictions"
_NEES = "squared error of the mean over the predicted covariance; 3 if calibrated, more if overconfident"
_OVERCONFIDENCE = "mean credible level of the truths minus 1/2; negative if underconfident"
_INSIDE = "share of truths inside the credible region"
_CONFORMAL = "share of truths inside; held-out samples set its level"
_ELLIPSOID = "share of truths inside the ellipsoid of mean and covariance that holds as much of a Gaussian"
_SQUARED = "squared Mahalanobis distance per dimension; 1 if calibrated, more if overconfident"
_HIDDEN = "of the frames that hide most of the object"
_SHARPNESS = "root mean square of the predicted deviation of"
_ROWS: tuple[tuple[str, str, str, int, str], ...] = (
    ("projected_error_mm", "Projected error", "mm", 1, "distance of the estimate from the true viewing ray"),
    ("depth_error_mm", "Depth error", "mm", 1, "error along the true viewing ray"),
    ("fused_error_mm", "Fused error of two cameras", "mm", 1, "distance in space of the mean of their product"),
    ("ale_m", "ALE", "m", 3, "average localisation error: error of the distance from the camera"),
    ("relative_error", "Relative error", "%", 2, "error of the distance from the camera over the distance"),
    ("nll", "NLL", "nats", 2, "mean negative log density at the truth, per cubic metre"),
    *((f"inside_{level}", f"Inside the {level} % region", "%", 1, _INSIDE) for level in (50, 90, 99)),
    ("inside_conformal", "Inside the conformal 90 % region", "%", 1, _CONFORMAL),
    ("unfamiliar", "Unfamiliar", "%", 1, "share of samples whose familiarity is below 0.05; 5 % at home"),
    ("auroc", "AUROC of familiarity", "", 2, "how well it separates the samples from those at home"),
    ("log_volume", "Log volume of the conformal 90 % region", "log m³", 2, "0.1 more is a volume 11 % larger"),
    ("depth_crps_mm", "CRPS of depth", "mm", 1, "continuous ranked probability score of the depth’s law"),
    ("energy_score_mm", "Energy score", "mm", 1, "continuous ranked probability score of the position in space"),
    ("depth_ence", "Depth ENCE", "", 3, "expected normalised calibration error of the depth’s variance"),
    ("projected_ence", "Projected ENCE", "", 3, "expected normalised calibration error of the variance of (x, y)/z"),
    ("miscalibration_area", "Miscalibration area", "", 3, "between coverage of credible regions and diagonal"),
    ("overconfidence", "Overconfidence", "", 3, _OVERCONFIDENCE),
    ("depth_pit_area", "Depth PIT area", "", 3, "between the distribution of the depth’s PIT and the diagonal"),
    ("depth_pit_ks", "Depth PIT distance", "", 3, "the largest gap between those two (Kolmogorov–Smirnov)"),
    ("group_miscalibration", "Worst-group miscalibration", "", 3, _WORST_GROUP),
    ("nees", "NEES", "", 2, _NEES),
    ("nees_x", "NEES of x", "", 2, "squared error of the mean of x over its variance, 1 if calibrated"),
    ("nees_y", "NEES of y", "", 2, "squared error of the mean of y over its variance, 1 if calibrated"),
    ("nees_z", "NEES of z", "", 2, "squared error of the mean of z over its variance, 1 if calibrated"),
    ("depth_sharpness_mm", "Depth sharpness", "mm", 1, f"{_SHARPNESS} z"),
    ("projected_sharpness_mrad", "Projected sharpness", "mrad", 2, f"{_SHARPNESS} x/z and y/z"),
    ("depth_risk_coverage_area", "Depth risk–coverage area", "mm", 1, _RISK),
    ("projected_risk_coverage_area", "Projected risk–coverage area", "mrad", 2, _RISK),
    ("depth_risk_coverage_excess", "Depth risk–coverage excess", "", 3, _EXCESS),
    ("projected_risk_coverage_excess", "Projected risk–coverage excess", "", 3, _EXCESS),
    ("level", "Mean level", "", 3, "mean credible level of the truths; 0.5 if calibrated, more if overconfident"),
    ("distance_mm", "Distance from the truth", "mm", 1, "distance in space"),
    *((f"coverage_{level}", f"Inside the {level} % ellipsoid", "%", 0, _ELLIPSOID) for level in (50, 90, 99)),
    ("normalised_squared_error", "Squared error over predicted", "", 2, _SQUARED),
    ("gain", "Depth error less than that of Kalman", "mm", 1, "positive if smaller than that of a Kalman smoother"),
    ("ratio/depth_error_mm", "Depth error over that of single frames", "", 2, "below 1 if smoothing helps"),
    ("hidden/depth_error_mm", "Depth error, hidden", "mm", 1, _HIDDEN),
    ("hidden/projected_error_mm", "Projected error, hidden", "mm", 1, _HIDDEN),
    ("ratio/hidden/depth_error_mm", "Depth error over that of single frames, hidden", "", 2, _HIDDEN),
)
SCORES = {key: Quantity(label, unit, digits, means) for key, label, unit, digits, means in _ROWS}
"""Key of a number -> quantity, in the order of a page."""

METHODS = {
    "mode": "Huber, mode", "mean": "Huber, mean", "shared": "shared", "average": "average", "gaussian": "Gaussian",
    "single": "single frames", "kalman": "Kalman (RTS)", "independent": "ours, independent frames",
    "slow": "ours, weighted frames",
}  # fmt: skip
"""Method of fusion or of smoothing -> its name."""

METRICS = {
    "projected_error_mm": SCORES["projected_error_mm"],
    "depth_error_mm": SCORES["depth_error_mm"],
    "nll": SCORES["nll"],
    "loss": Quantity("Loss", "", 3, "what training minimises"),
    "depth_precision": Quantity("Depth precision a", "", 1, "1/a: about the predicted relative error of the depth"),
    "projected_precision": Quantity(
        "Projected precision |A|", "", 0, "1/√|A|: about the predicted error of (x, y)/z"
    ),
}
"""Key of metrics.jsonl, after `train/` or `test/` -> quantity, in the order of a page."""
