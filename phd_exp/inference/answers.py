"""A sighting as one JSON object, in the frame of the real camera."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from phd_exp.distributions import ProjectedHuber, Temperature
from phd_exp.distributions.along import quantiles_along
from phd_exp.geometry.camera import Camera
from phd_exp.inference.sightings import Sighting
from phd_exp.inference.views import View
from phd_exp.metrics.errors import MILLIMETRES, depth_error, projected_error

LEVELS = (50, 90, 99)
"""Per cent of the credible intervals of depth."""
DIGITS = 8


def answer(sighting: Sighting, temperature: Temperature | None) -> dict[str, Any]:
    """The prediction for a detection, with its errors if the true position is known.

    Lengths are in metres, in the frame of the real camera: x right, y down, z (depth) forward along its axis. This is
    exact for a turned virtual camera too: points and covariance are rotated, and depth quantiles are integrated along
    the axis of the real camera (`quantiles_along`).
    """
    prediction, view, line = sighting.prediction, sighting.view, sighting.detection.line
    named: dict[str, Any] = {"file_name": line.file_name}
    if line.box is not None:
        named["box"] = list(line.box)
    if isinstance(prediction, ProjectedHuber):
        named |= _distribution(prediction, view) | {"uncertainty": uncertainty(temperature)}
    else:
        position = view.camera.to_real(_array(prediction.mode))
        named |= {"position": rounded(position), "uncertainty": "none: this model predicts a position alone"}
    camera = Camera(torch.tensor(view.camera.f, dtype=torch.float64), view.camera.S)
    named["out_of_field"] = not bool(camera.contains(prediction.mode))
    return named | (_errors(sighting) if line.z is not None else {})


def _distribution(distribution: ProjectedHuber, view: View) -> dict[str, Any]:
    R = view.camera.R
    quantiles = _depth_quantiles(distribution, view)
    return {
        "mode": rounded(view.camera.to_real(_array(distribution.mode))),
        "mean": rounded(view.camera.to_real(_array(distribution.mean))),
        "covariance": rounded(R.T @ _array(distribution.covariance_matrix) @ R),
        "median_depth": None if quantiles is None else rounded(quantiles[0]),
        "depth_interval": {
            str(level): None if quantiles is None else rounded(quantiles[[1 + place, -1 - place]])
            for place, level in enumerate(LEVELS)
        },
    }


def _depth_quantiles(distribution: ProjectedHuber, view: View) -> Float[np.ndarray, " quantiles"] | None:
    """The median of depth, then the lower ends of the intervals and the upper ones, the last first.

    None where the mode lies 90 degrees or more from the axis of the real camera, far out of the field.
    """
    tails = [(1 - level / 100) / 2 for level in LEVELS]
    p = np.array([0.5, *tails, *(1 - tail for tail in reversed(tails))])
    axis = view.camera.R[:, 2]  # that of the real camera, in the frame of the virtual one
    if not axis @ _array(distribution.mode) > 0:
        return None
    return quantiles_along(distribution, axis, p)


def uncertainty(temperature: Temperature | None) -> str:
    """The origin of the uncertainty: as trained, or recalibrated."""
    if temperature is None:
        return "as trained"
    return f"recalibrated: A / {temperature.projected:.4g}, a / {temperature.depth:.4g}"


def _errors(sighting: Sighting) -> dict[str, Any]:
    """The errors of the tables, which rotating the camera does not change, and the scores of a distribution."""
    prediction = sighting.prediction
    truth = torch.from_numpy(sighting.view.camera.to_virtual(np.array(sighting.detection.position)))
    errors = {
        "projected_error_mm": MILLIMETRES * projected_error(truth, prediction.mode),
        "depth_error_mm": MILLIMETRES * depth_error(truth, prediction.mode),
    }
    if isinstance(prediction, ProjectedHuber):
        errors |= {"credible_level": prediction.level(truth), "nll": -prediction.log_prob(truth)}
    return {name: rounded(value.numpy()) for name, value in errors.items()}


def _array(tensor: torch.Tensor) -> Float[np.ndarray, "..."]:
    array: np.ndarray = tensor.detach().cpu().double().numpy()
    return array


def rounded(values: Float[np.ndarray, "..."]) -> Any:
    """Lists of numbers for JSON; None for a number that is not finite."""
    if np.ndim(values):
        return [rounded(value) for value in values]
    return float(f"{values:.{DIGITS}g}") if np.isfinite(values) else None
