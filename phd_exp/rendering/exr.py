"""The one kind of OpenEXR file that Blender is asked for here: half floats, one block a row, not compressed.

Blender hands pixels out through files alone in background mode, and of those only OpenEXR keeps the light of an
overexposed pixel.
"""

import numpy as np
from numpy.typing import NDArray


def read_light(content: bytes, height: int, width: int) -> NDArray[np.float64]:
    """Linear light (height, width, 3), rows from the top, from such a file of three channels.

    Raises:
        ValueError: it is of another kind, or of another size.

    Source: "OpenEXR file layout" of the OpenEXR documentation: the rows are the end of the file, each its number and
    its length (int32), then blue, green and red.
    """
    row = np.dtype([("number", "<i4"), ("length", "<i4"), ("light", "<f2", (3, width))])
    begin = len(content) - height * row.itemsize
    if content[:4] != b"\x76\x2f\x31\x01" or begin <= 0:
        raise ValueError(f"not an uncompressed OpenEXR file of {width} x {height} pixels")
    rows = np.frombuffer(content, row, count=height, offset=begin)
    steps = np.diff(rows["number"])
    if (rows["length"] != 6 * width).any() or (steps != 1).any():
        raise ValueError(f"an OpenEXR file, but not of {height} rows of {width} pixels in half floats")
    return rows["light"][:, ::-1].transpose(0, 2, 1).astype(np.float64)
