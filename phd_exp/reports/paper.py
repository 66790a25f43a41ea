"""The numbers that the paper publishes, to stand beside ours."""

from dataclasses import dataclass


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
