"""What the paper publishes, how it lays it out, and what no estimator can beat: to stand beside ours."""

from dataclasses import dataclass
from typing import Literal

from phd_exp.evaluation.point_errors import Estimate, Quantity

TableName = Literal["table1", "table2"]


@dataclass(frozen=True)
class Published:
    """One cell of the paper's tables: mean errors over 2000 test samples, millimetres."""

    projected_error_mm: float
    depth_error_mm: float


PUBLISHED = {
    # Table 1
    ("mae_vz", "default"): Published(3.6, 69),
    ("mae_vz", "occl"): Published(22.8, 218),
    ("mae_vz", "scale"): Published(3.7, 359),
    ("mae_vz", "occl_scale"): Published(37.2, 386),
    ("mae_logz", "default"): Published(5.0, 36),
    ("mae_logz", "occl"): Published(18.0, 178),
    ("mae_logz", "scale"): Published(5.1, 355),
    ("mae_logz", "occl_scale"): Published(27.6, 355),
    ("probabilistic", "default"): Published(2.4, 48),
    ("probabilistic", "occl"): Published(13.0, 168),
    ("probabilistic", "scale"): Published(1.6, 347),
    ("probabilistic", "occl_scale"): Published(17.0, 350),
    # Table 2, where it is not Table 1's
    ("mae_xyz", "default"): Published(13.0, 327),
    ("mae_constf", "default"): Published(10.8, 325),
}
"""(model, data set) -> published errors."""


def published_mm(model: str, data: str, estimate: Estimate, quantity: Quantity) -> float | None:
    """The paper's figure; it has none of means and medians: its point estimate is the mode."""
    cell = PUBLISHED.get((model, data))
    if cell is None or estimate != "mode":
        return None
    return cell.projected_error_mm if quantity == "projected" else cell.depth_error_mm


FLOOR_OF_SCALE = 291.0
"""Bayes depth MAE, mm: z ~ U(3, 5) m, size factor ~ U(0.8, 1.2), of which only size / z is seen."""
FLOOR_WITHOUT_F = 331.0
"""The same: known size, f ~ U(1200, 2000) px, of which only f / z is seen."""
FLOOR_OF_NOTHING = 500.0
"""The same: nothing is seen, the estimate is always 4 m."""

TOLD_NO_F = ("mae_xyz", "mae_constf")


def floor_mm(model: str, data: str, quantity: Quantity) -> float | None:
    """The mean error below which no estimator that is told what the model is told can come; None: none is known."""
    if quantity == "projected":
        return None
    if model in TOLD_NO_F:
        return FLOOR_WITHOUT_F if data == "default" else None
    return FLOOR_OF_SCALE if data in ("scale", "occl_scale") else None


@dataclass(frozen=True)
class Column:
    """One column of a table: a data set, and an error unless each line has its own."""

    data: str
    quantity: Quantity | None = None


@dataclass(frozen=True)
class Line:
    """One line of a table: a model's point estimate, and an error unless each column has its own."""

    model: str
    estimate: Estimate
    quantity: Quantity | None = None

    def quantity_in(self, column: Column) -> Quantity:
        """The error that stands where this line meets a column."""
        quantity = self.quantity or column.quantity
        assert quantity is not None, "a layout gives the error to its lines or to its columns"
        return quantity


@dataclass(frozen=True)
class Floor:
    """A line of floors of depth error: data set -> what stands there."""

    label: str
    depth: dict[str, str]


@dataclass(frozen=True)
class Layout:
    """One of the paper's tables: columns, groups of lines, and the floors below them."""

    name: TableName
    title: str
    columns: tuple[Column, ...]
    groups: tuple[tuple[Line, ...], ...]
    floors: tuple[Floor, ...]
    note: str

    @property
    def choices(self) -> list[tuple[str, str]]:
        """Every (data set, model) of the table."""
        return [
            (column.data, line.model) for group in self.groups for line in group for column in self.columns
        ]


def _groups(models: tuple[str, ...], quantities: tuple[Quantity | None, ...]) -> tuple[tuple[Line, ...], ...]:
    """The paper's lines, and below them what it leaves out: mean and median of the density."""
    return (
        tuple(Line(model, "mode", quantity) for model in models for quantity in quantities),
        tuple(Line("probabilistic", "mean", quantity) for quantity in quantities)
        + tuple(Line("probabilistic", "median", quantity) for quantity in quantities),
    )


ASSUMED = (
    "Floors: the depth error of the best estimator there can be, the posterior median, over the whole law of depth "
    "z ~ U(3, 5) m, if all that the image tells of depth is seen exactly. The two readings share them: the place in "
    "the image says nothing of depth. The error is taken along the ray, at most 1 % longer than z. Means over 2000 "
    "test images scatter about a floor by some 5 mm, over fewer by more."
)
_DATA = ("default", "occl", "scale", "occl_scale")

TABLE_1 = Layout(
    name="table1",
    title="Table 1",
    columns=tuple(Column(data) for data in _DATA),
    groups=_groups(("mae_vz", "mae_logz", "probabilistic"), ("projected", "depth")),
    floors=(
        Floor(
            "no estimator can beat",
            {"scale": f"{FLOOR_OF_SCALE:.0f}", "occl_scale": f"≥ {FLOOR_OF_SCALE:.0f}"},
        ),
        Floor("knowing nothing", dict.fromkeys(_DATA, f"{FLOOR_OF_NOTHING:.0f}")),
    ),
    note="Of an object whose size factor ~ U(0.8, 1.2) is unknown, the image tells size / z alone; "
    "what hides a part of it can only add to that floor.",
)
TABLE_2 = Layout(
    name="table2",
    title="Table 2",
    columns=(Column("default", "projected"), Column("default", "depth")),
    groups=_groups(("mae_xyz", "mae_constf", "probabilistic"), (None,)),
    floors=(
        Floor("no estimator can beat without f", {"default": f"{FLOOR_WITHOUT_F:.0f}"}),
        Floor("knowing nothing", {"default": f"{FLOOR_OF_NOTHING:.0f}"}),
    ),
    note="To mae_xyz and mae_constf, which are not told f ~ U(1200, 2000) px, the image tells f / z "
    "alone; the floor without f does not bind the probabilistic model.",
)
LAYOUTS = (TABLE_1, TABLE_2)
