"""How each problem of a batch ended."""

from enum import IntEnum

from phd_exp.records.errors import UserError


class FusionError(UserError):
    """Problems that have no fused position, with the reason for each."""


class Status(IntEnum):
    """How a problem ended; all but FUSED are failures and carry NaN in place of numbers."""

    FUSED = 0
    NO_CAMERA = 1
    NOT_FINITE = 2
    NOT_A_ROTATION = 3
    NOT_A_PLANE = 4
    NO_COMMON_VIEW = 5
    PLANE_BEHIND_CAMERA = 6
    CONTRADICTION = 7
    NOT_CONVERGED = 8

    @property
    def reason(self) -> str:
        """What is wrong, what was expected and what to look at, in one line."""
        return _REASONS[self]


_REASONS = {
    Status.FUSED: "fused",
    Status.NO_CAMERA: "no camera takes part; expected at least one that is not masked out",
    Status.NOT_FINITE: "a prediction, pose or plane is not finite; mask that camera out or mend its numbers",
    Status.NOT_A_ROTATION: "a pose's R is not a rotation to 1e-6; expected R R^T = I and |R| = 1",
    Status.NOT_A_PLANE: "the plane's normal is zero; expected a direction",
    Status.NO_COMMON_VIEW: "no position is in front of every camera; check that poses map world to camera, R v + t",
    Status.PLANE_BEHIND_CAMERA: "no point of the plane is in front of every camera; check its normal and offset",
    Status.CONTRADICTION: (
        "at least half of the views rule out every common position; check the poses, the plane, and that all "
        "cameras see the same object"
    ),
    Status.NOT_CONVERGED: "the optimum was not found to the precision of the arithmetic; are its numbers extreme?",
}
