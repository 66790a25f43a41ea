"""Linear light and 8-bit sRGB (IEC 61966-2-1)."""

import numpy as np
from numpy.typing import NDArray

Light = NDArray[np.float64]
Pixels = NDArray[np.uint8]


def linear(signal: float) -> float:
    """The light that a signal of 0 to 1 stands for."""
    return signal / 12.92 if signal <= 0.04045 else ((signal + 0.055) / 1.055) ** 2.4


def encoded(light: Light) -> Pixels:
    """Linear light to 8-bit sRGB, clipped where a picture can show no more."""
    return np.searchsorted(_STEPS, light, side="right").astype(np.uint8)


_STEPS: Light = np.array([linear((value + 0.5) / 255) for value in range(255)])
"""The light at which the nearest 8-bit value becomes the next one."""
