"""The text of a camera file as plain containers: JSON, YAML, OpenCV's XML, ROS's INI, or COLMAP's `cameras.txt`.

Source: documentation of OpenCV's FileStorage, of ROS's camera_calibration_parsers, and of COLMAP's text format.
"""

import re
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

from phd_exp.records.parsing import parse_json, parse_yaml

COLMAP = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fl_x fl_y cx cy",
    **{"SIMPLE_RADIAL": "f cx cy k1", "SIMPLE_RADIAL_FISHEYE": "f cx cy k1"},
    **{"RADIAL": "f cx cy k1 k2", "RADIAL_FISHEYE": "f cx cy k1 k2"},
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
}
"""The parameters of COLMAP's models, named as in nerfstudio's `transforms.json`."""
_SECTION = re.compile(r"\[([A-Za-z][^\]\"'{}:,]*)\]")
_ROW = re.compile(r"\d+\s+[A-Z_]+\s+\d+\s+\d+(\s+[-+.\deE]+)+")
_OF_OPENCV = re.compile(r"^%YAML.*$|!!opencv-(nd-)?matrix", re.MULTILINE)
_NO_SPACE = re.compile(r"^(\s*[\w.]+):(?=[\w\[-])", re.MULTILINE)  # which OpenCV does not need
_ELSEWHERE = ("roi", "calobjectSize", "rotation", "quaternion", "orientation")
"""Sections whose width, height and w are not those of the image."""


def content_of(text: str) -> Any:
    """The content of a file; its format is that of its first lines. Raises ValueError if it is in none of them."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if lines and _SECTION.fullmatch(lines[0]):
        return _ini(lines)
    if lines and all(map(_ROW.fullmatch, lines)):
        return [_of_colmap(line.split()) for line in lines]
    if text.lstrip().startswith("<"):
        return _of_xml(text)
    if text.lstrip().startswith(("{", "[")):
        return parse_json(text)
    text = _NO_SPACE.sub(r"\1: ", _OF_OPENCV.sub("", text))
    return [parse_yaml(part) for part in re.split(r"^---.*$", text, flags=re.MULTILINE)]


def entries(node: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """All values with their keys, those of outer containers before a dot; OpenCV's and ROS's matrices are values."""
    if isinstance(node, dict) and "data" not in node:
        for name, inner in node.items():
            if name not in _ELSEWHERE:
                yield from entries(inner, f"{key}.{name}" if key else str(name))
    elif isinstance(node, list) and any(isinstance(item, dict) for item in node):
        for item in node:
            yield from entries(item, key)
    elif key:
        yield key, node


def _ini(lines: list[str]) -> dict[str, Any]:
    """Sections of names, with the numbers of each on the lines below it, or after `=`."""
    sections: dict[str, dict[str, list[str]]] = {}
    words: list[str] = []
    for part in (part.strip() for line in lines for part in line.split("=")):
        if found := _SECTION.fullmatch(part):
            section = sections.setdefault(found[1], {})
        elif re.fullmatch(r"[-+.\deE\s]+", part):
            words.extend(part.split())
        else:
            words = section.setdefault(part, [])
    return {name: {key: _one(given) for key, given in section.items()} for name, section in sections.items()}


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
    words = (element.text or "").split()
    return words if element.tag == "data" else _one(words)


def _one(words: list[str]) -> Any:
    return words[0] if len(words) == 1 else words
