"""Scenes as JSON objects: one position from several cameras, or from one camera and a known plane."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from phd_exp.fusion import Fused, Plane, Pose, Status, fuse, fuse_shared
from phd_exp.inference.answers import Sighting, rounded, uncertainty
from phd_exp.inference.predictor import Predictor
from phd_exp.metrics.errors import MILLIMETRES, squared_mahalanobis
from phd_exp.records.errors import DatasetError
from phd_exp.records.own_images import Observed

AGREE = 0.01
"""Largest distance between the true positions that lines of a scene give, relative to that from the camera."""


def fused_answers(
    scenes: Sequence[Observed],
    sightings: Iterable[Sighting],
    predictor: Predictor,
    plane: Plane | None,
    shared_scale: float | None = None,
) -> list[dict[str, Any]]:
    """The fused position of each scene, with its errors if the true position is known; `for_json` rounds the numbers.

    Lengths are in metres, in the world of the poses. A scene that fails has NaN for numbers and its `reason`.

    Args:
        scenes: the scenes to fuse.
        sightings: those of their detections, one scene after the other.
        predictor: the probabilistic predictor that made the sightings.
        plane: contains every position, if given.
        shared_scale: the `share` of `fuse_shared`; None for independent views.

    Raises DatasetError, before the first sighting is computed, if lines of a scene give different true positions.
    """
    truth = torch.stack([_true_position(scene) for scene in scenes])
    # no image is kept
    views = [(one.raw, one.view.camera, one.familiar, one.warnings) for one in sightings]
    raw, cameras, familiar, warnings = map(list, zip(*views, strict=True))
    f = torch.tensor([camera.f for camera in cameras], dtype=torch.float64)
    # the views of each scene, padded to the most cameras, and which of them exist
    counts = [len(scene.detections) for scene in scenes]
    rows = pad_sequence(torch.arange(sum(counts)).split(counts), batch_first=True)
    mask = torch.arange(rows.shape[1]) < torch.tensor(counts)[:, None]
    predictions = predictor.predict(torch.stack(raw)[rows], f[rows])
    assert predictions.has_closed_forms
    way = fuse if shared_scale is None else partial(fuse_shared, share=shared_scale)
    pose = _virtual(Pose.from_scene([pose for scene in scenes for pose in scene.poses]), [one.R for one in cameras])
    fused = way(predictions, Pose(pose.R[rows], pose.t[rows]), plane, mask)
    directions = None if plane is None else plane.directions
    errors = {
        "error_mm": MILLIMETRES * (fused.point - truth).norm(dim=-1),
        "squared_mahalanobis": squared_mahalanobis(truth - fused.mean, fused.covariance, directions),
    }
    origin, answers, first = {"uncertainty": uncertainty(predictor.temperature)}, [], 0
    for place, (scene, n) in enumerate(zip(scenes, counts, strict=True)):
        names, here = [one.line.file_name for one in scene.detections], slice(first, first + n)
        warned = [f"{one}; {name}" for name, found in zip(names, warnings[here], strict=True) for one in found]
        unusual = {} if None in familiar[here] else {"familiar": rounded(np.array(familiar[here]))}
        known = bool(truth[place].isfinite().all())
        scores = {name: value[place].numpy() for name, value in errors.items() if known}
        answers.append(_answer(scene, fused, place) | origin | {"warnings": warned} | unusual | scores)
        first += n
    return answers


def for_json(answer: Mapping[str, Any]) -> dict[str, Any]:
    """An answer with lists of rounded numbers; None for NaN."""
    return {name: rounded(value) if isinstance(value, np.ndarray) else value for name, value in answer.items()}


def fused_region(answer: Mapping[str, Any], guarantees: Mapping[int, dict[str, Any]]) -> dict[str, Any]:
    """The ellipsoid of a fused answer: its guarantee, the ends of x, y and z (m), and its volume (m^3)."""
    if answer["status"] != Status.FUSED.name.lower():
        return {}
    facts, mean = guarantees[len(answer["file_names"])], answer["mean"]
    scaled = facts["squared_mahalanobis"] * answer["covariance"]
    reach, volume = np.sqrt(scaled.diagonal()), 4 / 3 * np.pi * np.sqrt(np.linalg.det(scaled))
    extent = rounded(np.stack([mean - reach, mean + reach], -1))
    return {"region": facts | {"extent": extent, "volume": rounded(volume)}}


def _virtual(real: Pose, R: Sequence[Float[np.ndarray, "3 3"]]) -> Pose:
    """The poses of virtual cameras, which are real ones turned: v_virtual = R_v v_camera gives (R_v R, R_v t)."""
    turn = torch.from_numpy(np.stack(R))
    return Pose(turn @ real.R, (turn @ real.t[..., None]).squeeze(-1))


def _true_position(scene: Observed) -> Float[Tensor, "3"]:
    """The true position of a scene's object in the world, metres; NaN if no line gives it.

    Raises DatasetError if two lines disagree by more than 1 % of its distance; poses or scenes are wrong then.
    """
    known = [(d, pose) for d, pose in zip(scene.detections, scene.poses, strict=True) if d.line.z is not None]
    if not known:
        return torch.full((3,), torch.nan, dtype=torch.float64)
    xyz = torch.tensor([detection.position for detection, _ in known], dtype=torch.float64)
    world = Pose.from_scene([pose for _, pose in known]).into_world(xyz)
    apart = (world - world[0]).norm(dim=-1)
    if bool((apart > AGREE * xyz.norm(dim=-1)).any()):
        worst = int(apart.argmax())
        raise DatasetError(
            f"{known[worst][0].where}: its x, y, z and pose place the object of scene {scene.scene!r} "
            f"{float(apart[worst]):.3g} m away from where {known[0][0].where} places it; check pose (world to "
            "camera, R v + t), scene and x, y, z"
        )
    return world.mean(0)


def _answer(scene: Observed, fused: Fused, place: int) -> dict[str, Any]:
    status = Status(int(fused.status[place]))
    named = {
        "scene": scene.scene,
        "file_names": [detection.line.file_name for detection in scene.detections],
        "status": status.name.lower(),
    }
    if status != Status.FUSED:
        named["reason"] = status.reason
    numbers = {name: getattr(fused, name)[place] for name in ("point", "mean", "covariance")}
    numbers["surprise"] = fused.surprise[place, : len(scene.detections)]
    if fused.shared is not None:
        numbers["shared_scale"] = fused.shared[0][place]
    return named | {name: value.numpy() for name, value in numbers.items()}
