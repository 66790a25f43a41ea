"""Light comes back as it was written; other files are refused."""

import numpy as np
import pytest

from phd_exp.rendering.pixels import read_light


def written(light: np.ndarray) -> bytes:
    """A file of the kind read, but for a header that nobody looks at."""
    rows = b"".join(
        np.array([number, 6 * light.shape[1]], "<i4").tobytes() + row.T[::-1].astype("<f2").tobytes()
        for number, row in enumerate(light, start=7)
    )
    return b"\x76\x2f\x31\x01" + b"header and offsets" + rows


@pytest.fixture
def light() -> np.ndarray:
    return np.random.default_rng(0).uniform(0, 50, (4, 5, 3)).astype("<f2").astype(float)


def test_light_comes_back(light: np.ndarray) -> None:
    assert (read_light(written(light), 4, 5) == light).all()


@pytest.mark.parametrize(("height", "width"), [(4, 4), (5, 4), (2, 10), (400, 500)])
def test_another_size_is_refused(light: np.ndarray, height: int, width: int) -> None:
    with pytest.raises(ValueError, match=f"{height}|{width}"):
        read_light(written(light), height, width)


@pytest.mark.parametrize("content", [b"", b"BM nonsense", b"\x76\x2f\x31\x01" + bytes(500)])
def test_what_is_no_such_file_is_refused(content: bytes) -> None:
    with pytest.raises(ValueError, match="OpenEXR"):
        read_light(content, 4, 5)
