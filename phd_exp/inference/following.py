"""An object followed through frames: each is predicted, the path is smoothed, and the path gives the next box."""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy import special

from phd_exp.distributions import ProjectedHuber
from phd_exp.fusion import Pose
from phd_exp.fusion.tracks import ConstantVelocity, Lost, Slow, State, Tracker
from phd_exp.fusion.tracks.motion import Motion
from phd_exp.inference.answers import PER_CENT, rounded, uncertainty
from phd_exp.inference.detectors import Detector, overlap
from phd_exp.inference.predictor import Predictor
from phd_exp.optics.lens import PINHOLE, Lens
from phd_exp.optics.virtual import Box, VirtualCamera, rays, towards
from phd_exp.records.errors import DatasetError, UserError, gist

USUAL = ConstantVelocity(noise=1.0)
SPREADS = 2.0  # standard deviations of the predicted position by which each side of its box is moved outwards
WIDEST = 0.25  # the most by which it is moved, over the size of the box: networks have met boxes about as tight
HERE = Pose(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


@dataclass(frozen=True, eq=False)
class Frame:
    """One image of a sequence.

    Args:
        time: seconds, later than that of the frame before.
        image: RGB.
        K: camera matrix, pixels, as `intrinsics` returns it.
        boxes: of a detector (left, top, right, bottom, px), the most certain first; empty if it found nothing or is
            not needed, None for predictions from the whole image.
        pose: of the camera in the world; by default its frame is the world.
        lens: of the camera.
        where: the place of the frame, for messages.
    """

    time: float
    image: UInt8[np.ndarray, "height width 3"]
    K: Float[np.ndarray, "3 3"]
    boxes: tuple[Box, ...] | None = None
    pose: Pose = HERE
    lens: Lens = PINHOLE
    where: str = "frame"


@dataclass(frozen=True, eq=False)
class Followed:
    """One frame and the state of the path there, given the frames up to `lag` later.

    Attributes:
        number: of the frame, from 0.
        track: of the track, from 0; after a lost one begins another.
        status: "tracked"; "bridged" if nothing was predicted or the prediction contradicts the path; "lost" before a
            track begins and from where it was lost.
        box: the part of the image that was predicted from, px; None if it was the whole image, or nothing.
        state: None if lost.
        familiar: p-value of the prediction among held-out samples, see `Predictor.familiar`.
        warnings: what is beyond the training, see `Ranges.warnings`.
        reason: why the track ended, with the first frame after it.
    """

    number: int
    frame: Frame
    track: int
    status: Literal["tracked", "bridged", "lost"] = "lost"
    box: Box | None = None
    state: State | None = None
    familiar: float | None = None
    warnings: tuple[str, ...] = ()
    reason: str | None = None

    @property
    def in_camera(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        """Mean (metres) and covariance (square metres) of the position in the frame of the camera."""
        assert self.state is not None
        R = self.frame.pose.R.numpy()
        mean = self.frame.pose.into_camera(self.state.mean).numpy()
        return mean, R @ self.state.covariance.numpy() @ R.T

    @property
    def facing(self) -> VirtualCamera:
        """The camera of the frame turned towards the mean position, with an image of one pixel."""
        return VirtualCamera(self.frame.K, towards(self.in_camera[0]), 1.0, 1.0, self.frame.lens)

    def answer(self, predictor: Predictor) -> dict[str, Any]:
        """The numbers of the frame as a JSON object; metres and seconds, in the world of the poses."""
        named: dict[str, Any] = {"frame": self.number, "time": self.frame.time, "track": self.track}
        named |= {"state": self.status, "warnings": list(self.warnings)}
        if self.reason:
            named["reason"] = self.reason
        if self.state is not None:
            state, (mean, covariance) = self.state, self.in_camera
            numbers = {"mode": state.point} | {
                name: getattr(state, name) for name in ("mean", "covariance", "velocity", "velocity_covariance")
            }
            named |= {name: rounded(value.numpy()) for name, value in numbers.items()}
            deviation = np.sqrt(covariance[2, 2])
            ends = {level: special.ndtri(0.5 + level / 200) * deviation for level in PER_CENT}
            named["depth_interval"] = {
                str(level): rounded(mean[2] + end * np.array([-1, 1])) for level, end in ends.items()
            }
            named["surprise"] = rounded(state.surprise[0].numpy())
            named["uncertainty"] = uncertainty(predictor.temperature)
        if self.familiar is not None:
            named["familiar"] = rounded(np.array(self.familiar))
        return named | ({"box": rounded(np.array(self.box))} if self.box else {})


def follow(
    predictor: Predictor,
    frames: Iterable[Frame],
    motion: Motion = USUAL,
    lag: int = 10,
    slow: Slow | None = None,
    lost: Lost | None = None,
    least_familiar: float = 0.0,
    detector: Detector | None = None,
    beyond: bool = False,
) -> Iterator[Followed]:
    """Each frame with its state, `lag` frames later; frames may come from a live camera.

    A box of a detector is needed in the first frame only. It is taken as an outline that faces the camera at the
    predicted position; the box of a later frame is this outline, wider by the spread, at the position that the path
    predicts. Where boxes are given, the one that overlaps most with the predicted one replaces it. After a track is
    lost, the next box begins another, and so does the next whole image. A prediction whose `familiar` is less than
    `least_familiar` takes no part after the first one: the object may be hidden. A detector finds the boxes of frames
    with none of their own, as long as no path predicts one: in the first frames, and after a track is lost. A view
    whose focal length is more than a fifth beyond those of the training takes no part, unless `beyond`.

    Raises:
        ConfigError: the predictor has no uncertainty.
        DatasetError: a box is not valid, a time is not later than the one before, no path is found, or the first
            view is that far beyond the training; the states of earlier frames are yielded first.
    """
    predictor.require_densities("a path needs")

    def begun(track: int) -> _Track:
        tracker = Tracker(motion, lag, slow or Slow(), lost or Lost())
        return _Track(predictor, tracker, track, least_familiar, detector, beyond)

    current = begun(0)
    try:
        for number, frame in enumerate(frames):
            yield from current.add(number, frame)
            if current.tracker.lost_because:
                current = begun(current.number + 1)
    except UserError:
        yield from current.finish()
        raise
    yield from current.finish()


@dataclass(eq=False)
class _Track:
    """One track: its tracker, the frames that wait for their state, and the outline of the last given box."""

    predictor: Predictor
    tracker: Tracker
    number: int
    least_familiar: float
    detector: Detector | None
    beyond: bool
    waiting: deque[Followed] = field(default_factory=deque)
    last: tuple[ProjectedHuber, Pose] | None = None  # prediction and pose of the virtual camera
    outline: "_Outline | None" = None

    def add(self, number: int, frame: Frame) -> Iterator[Followed]:
        """The frames whose state is known with this one."""
        box, given = self._box(frame)
        followed, is_seen = self._seen(number, frame, box)
        if self.last is None:
            yield followed
            return
        self.waiting.append(followed)
        try:
            state = self.tracker.update(frame.time, *self.last, torch.tensor([is_seen]))
        except ValueError as error:
            self.waiting.pop()
            raise DatasetError(f"{frame.where}: no path through this frame ({gist(error)})") from None
        if self.outline:
            self.outline.age += 1
        if given and box:
            self.outline = _Outline.of(box, frame)
        if state:
            yield self._entered(state)
        if self.tracker.lost_because:
            yield from self.finish()

    def finish(self) -> Iterator[Followed]:
        """The other frames."""
        for state in self.tracker.finish():
            yield self._entered(state)
        reason = self.tracker.lost_because
        while self.waiting:
            yield replace(self.waiting.popleft(), reason=reason)
            reason = None

    def _entered(self, state: State) -> Followed:
        agrees = bool((state.surprise <= 1 - self.tracker.lost.probability).any())  # NaN without a prediction
        return replace(self.waiting.popleft(), state=state, status="tracked" if agrees else "bridged")

    def _seen(self, number: int, frame: Frame, box: Box | None) -> tuple[Followed, bool]:
        """The frame, with its prediction if there is one, and whether that takes part in the path.

        Raises DatasetError if the very first view is too far beyond the training.
        """
        followed = Followed(number, frame, self.number)
        if frame.boxes is not None and box is None:
            return followed, False
        view = self.predictor.view(frame.image, frame.K, box, frame.lens, frame.where)
        seen = self.predictor.predicted([view])
        refusal = None if self.beyond else self.predictor.ranges.refusal(view.camera)
        if refusal and self.last is None and self.number == 0:
            raise DatasetError(f"{frame.where}: {refusal}")
        familiar = seen.familiar[0] if seen.familiar else None
        is_usual = self.last is None or familiar is None or familiar >= self.least_familiar
        if takes_part := is_usual and not refusal:
            assert seen.predictions.has_closed_forms  # checked by `follow`
            R = torch.from_numpy(view.camera.R)
            self.last = seen.predictions, Pose(R @ frame.pose.R, R @ frame.pose.t)
        return replace(followed, box=box, familiar=familiar, warnings=tuple(seen.warnings[0])), takes_part

    def _box(self, frame: Frame) -> tuple[Box | None, bool]:
        """The part of the image to predict from, and whether the frame or the detector gives it."""
        predicted, boxes = self._predicted_box(frame), frame.boxes or ()
        if self.detector and frame.boxes == () and not predicted:
            boxes = tuple(row["box"] for row in self.detector.boxes_in(frame.image, frame.where))
        box = _best(boxes, predicted)
        return box or predicted, box is not None

    def _predicted_box(self, frame: Frame) -> Box | None:
        """The box at the position that the path predicts; None where that is outside the image."""
        if (outline := self.outline) is None or frame.boxes is None:
            return None
        if outline.age <= self.tracker.lag:  # its frame's position is still known better with each frame
            outline.place(self.tracker.position(outline.frame.time)[0])
        mean, covariance = self.tracker.position(frame.time)
        R = frame.pose.R.numpy()
        return outline.box(frame, frame.pose.into_camera(torch.from_numpy(mean)).numpy(), R @ covariance @ R.T)


@dataclass(eq=False)
class _Outline:
    """A box as the corners of a shape that faces the camera at the object.

    Attributes:
        frame: of the box.
        rays: unit vectors through its corners.
        age: how many frames followed.
        corners: relative to the object, in a frame whose third axis leads from the camera to it, metres.
    """

    frame: Frame
    rays: Float[np.ndarray, "4 3"]
    age: int = 0
    corners: Float[np.ndarray, "4 3"] = field(init=False)

    @classmethod
    def of(cls, box: Box, frame: Frame) -> "_Outline | None":
        """That of a box; None if a corner lies beyond the field of the lens."""
        left, top, right, bottom = box
        corners = np.array([[left, top], [right, top], [left, bottom], [right, bottom]])
        through = rays(frame.K, corners, frame.lens)
        through /= np.linalg.norm(through, axis=-1, keepdims=True)
        return cls(frame, through) if np.isfinite(through).all() else None

    def place(self, position: Float[np.ndarray, "3"]) -> None:
        """Sets the corners, for an object at a position in the world (metres)."""
        here = self.frame.pose.into_camera(torch.from_numpy(position)).numpy()
        self.corners = (np.linalg.norm(here) * self.rays - here) @ towards(here).T

    @np.errstate(invalid="ignore")  # straight behind the camera
    def box(self, frame: Frame, position: Float[np.ndarray, "3"], covariance: Float[np.ndarray, "3 3"]) -> Box | None:
        """The box at a position in the frame of the camera (metres), moved outwards by its spread.

        None if its middle lies outside the image, or no virtual camera shows it.
        """
        turn = towards(position)
        spread = np.sqrt((turn @ covariance @ turn.T).diagonal()[:2])
        corners = self.corners.copy()
        outwards = corners[:, :2] - corners[:, :2].mean(0)
        corners[:, :2] += np.sign(outwards) * np.minimum(SPREADS * spread, 2 * WIDEST * np.abs(outwards))
        place = frame.lens.distort(position + corners @ turn)
        pixels = frame.K[:2, 2] + np.diagonal(frame.K)[:2] * place
        (left, top), (right, bottom) = pixels.min(0), pixels.max(0)
        height, width = frame.image.shape[:2]
        if not (0 <= left + right <= 2 * width and 0 <= top + bottom <= 2 * height):  # NaN too
            return None
        box = float(left), float(top), float(right), float(bottom)
        try:
            VirtualCamera.of_box(frame.K, box, 1.0, frame.lens)
        except ValueError:
            return None
        return box


def _best(boxes: tuple[Box, ...], predicted: Box | None) -> Box | None:
    """The box that overlaps most with the predicted one, the first without one; None if there is none."""
    if predicted is None:
        return boxes[0] if boxes else None
    share, place = max(((overlap(box, predicted), -k) for k, box in enumerate(boxes)), default=(0.0, 0))
    return boxes[-place] if share > 0 else None
