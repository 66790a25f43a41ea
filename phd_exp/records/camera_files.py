"""The text of a camera file as plain containers: JSON, YAML, TOML, OpenCV's XML, ROS's INI, COLMAP's `cameras.txt`,
or numbers alone.

Source: documentation of OpenCV's FileStorage, of ROS's camera_calibration_parsers, and of COLMAP's text format.
"""

import re
import tomllib
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

from phd_exp.records.errors import gist, shortened
from phd_exp.records.parsing import parse_json, parse_yaml

COLMAP = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fl_x fl_y cx cy",
    **dict.fromkeys(("SIMPLE_RADIAL", "SIMPLE_RADIAL_FISHEYE"), "f cx cy k1"),
    **dict.fromkeys(("RADIAL", "RADIAL_FISHEYE"), "f cx cy k1 k2"),
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
}
"""The parameters of COLMAP's models, named as in nerfstudio's `transforms.json`."""
READ = (
    "ROS (camera_info, ost.ini), OpenCV's FileStorage, Kalibr, COLMAP (cameras.txt), nerfstudio (transforms.json), "
    "Anipose (TOML), the numbers of K or fx fy cx cy, or JSON or YAML with K, D, distortion_model, width and height"
)
_SECTION = re.compile(r"\[([A-Za-z][^\]\"'{}:,]*)\]")
_NUMBERS = r"(?:[-+]?[\d.]+(?:[eE][-+]?\d+)?[\s,]*)+"
_OF_INI = re.compile(rf"^([A-Za-z].*)\n({_NUMBERS})", re.MULTILINE)
_OF_OPENCV = re.compile(r"^%YAML.*$|!!opencv-(nd-)?matrix", re.MULTILINE)
_NO_SPACE = re.compile(r"^(\s*[\w.]+):(?=[\w\[-])", re.MULTILINE)  # which OpenCV does not need
_ELSEWHERE = ("rotation", "quaternion", "orientation")
"""Sections whose w is not the width of the image."""


def content_of(text: str) -> Any:
    """The content of a file. Raises ValueError if it is in no format that is read."""
    try:
        return _content_of(text)
    except ValueError as error:
        raise ValueError(f"{shortened(gist(error))}; expected {READ}") from None


def _content_of(text: str) -> Any:
    """The content of a file, whose format is that of its first lines."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if lines and _SECTION.fullmatch(lines[0]):
        if any("=" in line for line in lines):
            return tomllib.loads(text)
        return [{name: numbers.split()} for name, numbers in _OF_INI.findall("\n".join(lines))]
    if lines and all(re.fullmatch(_NUMBERS, line) for line in lines):
        return _of_numbers([line.replace(",", " ").split() for line in lines])
    if lines and all(re.fullmatch(rf"\d+\s+[A-Z_]+\s+\d+\s+\d+\s+{_NUMBERS}", line) for line in lines):
        return [_of_colmap(line.split()) for line in lines]
    if text.lstrip().startswith("<"):
        return _of_xml(text)
    if text.lstrip().startswith(("{", "[")):
        return parse_json(text)
    text = _NO_SPACE.sub(r"\1: ", _OF_OPENCV.sub("", text))
    return [parse_yaml(part) for part in re.split(r"^---.*$", text, flags=re.MULTILINE)]


def entries(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """All values with their keys, those of outer containers before a dot; OpenCV's and ROS's matrices are values, and
    so is ROS's region of interest.
    """
    if isinstance(node, dict) and not {"data", "x_offset"} & node.keys():
        for name, inner in node.items():
            if name not in _ELSEWHERE:
                yield from entries(inner, f"{key}.{name}" if key else str(name))
    elif isinstance(node, list) and any(isinstance(item, dict) for item in node):
        for item in node:
            yield from entries(item, key)
    elif key:
        yield key, node


def _of_numbers(rows: list[list[str]]) -> dict[str, Any]:
    """K, as `numpy.savetxt` writes it, or fx, fy, cx, cy, and maybe k1, k2, p1, p2 and k3, on one line."""
    if [len(row) for row in rows] == [3, 3, 3]:
        return {"K": rows}
    words = [word for row in rows for word in row]
    if len(rows) == 1 and len(words) in (4, 8, 9):
        return {"K": words[:4], "D": words[4:], "distortion_model": "plumb_bob" if words[4:] else "none"}
    raise ValueError(f"{len(words)} numbers; expected K, 3 x 3, or one line of fx fy cx cy, or with k1 k2 p1 p2")


def _of_colmap(words: list[str]) -> dict[str, Any]:
    _, model, width, height, *numbers = words
    names = COLMAP.get(model, "").replace("f ", "fl_x ").split()
    if len(names) != len(numbers):
        raise ValueError(f"{model} with {len(numbers)} parameters; expected one of {', '.join(COLMAP)}")
    camera = {"camera_model": model, "w": width, "h": height} | dict(zip(names, numbers, strict=True))
    return {"fl_y": camera["fl_x"]} | camera


def _of_xml(text: str) -> Any:
    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise ValueError("XML with a document type declaration")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"XML: {error}") from None
    if root.tag != "opencv_storage":
        raise ValueError(f"XML of <{root.tag}>; expected <opencv_storage>")
    return _of_element(root)


def _of_element(element: ElementTree.Element) -> Any:
    if len(element):
        return {child.tag: _of_element(child) for child in element}
    return (element.text or "").split() if element.tag == "data" else (element.text or "").strip()
