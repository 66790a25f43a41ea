"""Paths: the predictions of one or several cameras over time, smoothed with a motion model.

`frames.py` checks the input, and `slow.py` weighs the frames. `newton.py` finds the most likely path,
and `gaussian.py` adds mean and covariance; these are compiled. `track.py` is the interface for whole sequences,
`tracker.py` for live ones.
"""

from phd_exp.fusion.tracks.frames import Gaussian
from phd_exp.fusion.tracks.lost import Lost
from phd_exp.fusion.tracks.motion import ConstantAcceleration, ConstantVelocity
from phd_exp.fusion.tracks.slow import Slow, correlation_time, standardised_errors
from phd_exp.fusion.tracks.track import Path, estimated, track
from phd_exp.fusion.tracks.tracker import State, Tracker

__all__ = [
    "ConstantAcceleration",
    "ConstantVelocity",
    "Gaussian",
    "Lost",
    "Path",
    "Slow",
    "State",
    "Tracker",
    "correlation_time",
    "estimated",
    "standardised_errors",
    "track",
]
