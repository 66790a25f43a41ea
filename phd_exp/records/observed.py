"""Scenes seen by several cameras: which lines of `metadata.jsonl` show the same object, and where cameras stand."""

from collections.abc import Sequence
from dataclasses import dataclass

from phd_exp.records.detections import Detection
from phd_exp.records.errors import DatasetError
from phd_exp.records.scenes import Pose


@dataclass(frozen=True)
class Observed:
    """One scene and the detections of its object, at least one, by cameras whose poses are known."""

    scene: int | str
    detections: tuple[Detection, ...]
    poses: tuple[Pose, ...]


def observed(detections: Sequence[Detection]) -> list[Observed]:
    """The scenes of detections, in the order in which they first appear.

    Raises DatasetError for a line that does not say which scene it shows, or where its camera stands.
    """
    views: dict[int | str, list[tuple[Detection, Pose]]] = {}
    for detection in detections:
        scene, pose = detection.line.scene, detection.line.pose
        if scene is None:
            raise DatasetError(
                f"{detection.where}: scene is missing; lines that show the same object at the same time have the "
                "same number or name there"
            )
        if pose is None:
            raise DatasetError(
                f"{detection.where}: pose is missing; expected the rotation [w, x, y, z] and translation of its "
                "camera, R v + t from the world to the camera"
            )
        views.setdefault(scene, []).append((detection, pose))
    return [
        Observed(scene, tuple(detection for detection, _ in seen), tuple(pose for _, pose in seen))
        for scene, seen in views.items()
    ]
