"""How an object moves between frames: white noise of its acceleration or of its jerk."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from typing import ClassVar, final

import numpy as np
from jaxtyping import Float


class Motion(ABC):
    """A motion with `order` derivatives, the position among them, of which the last one is driven by white noise."""

    order: ClassVar[int]
    noise: float

    @property
    @abstractmethod
    def deviations(self) -> tuple[float, ...]:
        """Standard deviations of the derivatives in the first frame, in each axis, before any prediction."""


@final
@dataclass(frozen=True)
class ConstantVelocity(Motion):
    """A velocity that changes by white noise of the acceleration.

    Args:
        noise: spectral density of the acceleration, m/s^2 per sqrt(Hz): the velocity changes by noise sqrt(s) in s
            seconds (standard deviation in each axis, m/s).
        speed: standard deviation of the first frame's velocity in each axis, m/s.

    Raises:
        ValueError: a number is not positive and finite.
    """

    order: ClassVar[int] = 2
    noise: float
    speed: float = 10.0

    def __post_init__(self) -> None:
        _require_positive(noise=self.noise, speed=self.speed)

    @property
    def deviations(self) -> tuple[float, ...]:
        """Of the velocity."""
        return (self.speed,)


@final
@dataclass(frozen=True)
class ConstantAcceleration(Motion):
    """An acceleration that changes by white noise of the jerk.

    Args:
        noise: spectral density of the jerk, m/s^3 per sqrt(Hz): the acceleration changes by noise sqrt(s) in s
            seconds (standard deviation in each axis, m/s^2).
        speed: standard deviation of the first frame's velocity in each axis, m/s.
        acceleration: standard deviation of the first frame's acceleration in each axis, m/s^2.

    Raises:
        ValueError: a number is not positive and finite.
    """

    order: ClassVar[int] = 3
    noise: float
    speed: float = 10.0
    acceleration: float = 10.0

    def __post_init__(self) -> None:
        _require_positive(noise=self.noise, speed=self.speed, acceleration=self.acceleration)

    @property
    def deviations(self) -> tuple[float, ...]:
        """Of velocity and acceleration."""
        return self.speed, self.acceleration


def transitions(
    motion: Motion, steps: Float[np.ndarray, " steps"]
) -> tuple[Float[np.ndarray, "steps order order"], Float[np.ndarray, "steps order order"]]:
    """Motion of one axis over these times (seconds), and the inverse covariance of its noise.

    F_ij = s^(j-i)/(j-i)! for j >= i. The noise has the covariance noise^2 s^(2m-1-i-j) / ((2m-1-i-j) (m-1-i)!
    (m-1-j)!) for m derivatives, and is inverted for s = 1, where it is well conditioned.

    Source: Bar-Shalom, Li and Kirubarajan, "Estimation with applications to tracking and navigation" (2001).
    """
    m = motion.order
    powers, taylor, inverse = _of_a_second(m)
    scale = steps[:, None] ** -(m - 0.5 - np.arange(m)) / motion.noise
    return taylor * steps[:, None, None] ** powers, scale[:, :, None] * inverse * scale[:, None, :]


@cache
def _of_a_second(m: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Powers of s in F and their factors, and the inverse covariance for s = 1 and noise 1."""
    i, j = np.indices((m, m))
    powers = np.maximum(j - i, 0)
    factorial = np.vectorize(math.factorial, otypes=[float])
    noise = 1 / ((2 * m - 1 - i - j) * factorial(m - 1 - i) * factorial(m - 1 - j))
    return powers, np.where(j >= i, 1 / factorial(powers), 0.0), np.linalg.inv(noise)


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise ValueError(f"{name}: got {value}; expected a positive number")
