"""The node of the guide to ROS 2, which cannot run here: its syntax and its names."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from phd_exp.inference.deployed import OfPhotographs
from phd_exp.inference.onnx import DESCRIPTIONS
from phd_exp.records.messages import typestore
from tests.docs.pages import DOCS, blocks

(TEXT,) = (block.text for block in blocks(DOCS / "guides" / "ros.md") if block.file)
TREE = ast.parse(TEXT)
DETECTIONS_2D = {
    "Point2D": "float64 x\nfloat64 y",
    "Pose2D": "Point2D position\nfloat64 theta",
    "BoundingBox2D": "Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "Detection2D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox2D bbox\nstring id",
    "Detection2DArray": "std_msgs/Header header\nDetection2D[] detections",
}
"""The fields of vision_msgs 4 that the package does not use."""
LIBRARIES = {
    "cv_bridge": {"CvBridge", "imgmsg_to_cv2"},
    "message_filters": {"ApproximateTimeSynchronizer", "Subscriber", "registerCallback"},
    "rclpy": {"init", "spin"},
    "rclpy.node": {"Node", "declare_parameter", "value", "create_publisher", "publish"},
    "rclpy.qos": {"qos_profile_sensor_data"},
}
"""Names of the libraries' documentation."""


def test_the_node_has_no_undefined_names(tmp_path: Path) -> None:
    file = tmp_path / "position_node.py"
    file.write_text(TEXT)
    words = ["check", "--isolated", "--no-cache", "--select=E,F", "--line-length=118", str(file)]
    done = subprocess.run([sys.executable, "-m", "ruff", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_the_node_uses_inputs_and_outputs_of_the_exported_file() -> None:
    (given,) = (node for node in ast.walk(TREE) if isinstance(node, ast.Dict))
    assert [ast.literal_eval(key) for key in given.keys if key] == list(OfPhotographs.inputs)
    (call,) = (
        node for node in ast.walk(TREE) if isinstance(node, ast.Call) and ast.unparse(node.func)[-4:] == ".run"
    )
    assert set(ast.literal_eval(call.args[0])) <= DESCRIPTIONS.keys()


def test_the_node_uses_messages_and_fields_that_exist() -> None:
    get_types = pytest.importorskip("rosbags.typesys", reason="needs the extra `ros`").get_types_from_msg
    known = dict(typestore().fielddefs)
    for name, fields in DETECTIONS_2D.items():
        known |= get_types(fields, f"vision_msgs/msg/{name}")
    imports = [node for node in ast.walk(TREE) if isinstance(node, ast.ImportFrom)]
    kinds = {
        name.name: f"{(node.module or '').replace('.', '/')}/{name.name}" for node in imports for name in node.names
    }
    messages = {name: kind for name, kind in kinds.items() if "/msg/" in kind}
    fields = {name: {field for field, _ in known[kind][1]} for name, kind in messages.items()}
    for call in (node for node in ast.walk(TREE) if isinstance(node, ast.Call)):
        if isinstance(call.func, ast.Name) and call.func.id in messages:
            assert {keyword.arg for keyword in call.keywords} <= fields[call.func.id], ast.unparse(call)
    every = {
        field
        for kind in known
        if kind.startswith(("vision_msgs", "geometry", "sensor"))
        for field, _ in known[kind][1]
    }
    used = {node.attr for node in ast.walk(TREE) if isinstance(node, ast.Attribute) and _is_of_messages(node)}
    assert used - every == set()


def test_the_node_uses_names_of_its_libraries() -> None:
    for node in ast.walk(TREE):
        if isinstance(node, ast.ImportFrom) and ".msg" not in (node.module or ""):
            assert {name.name for name in node.names} <= LIBRARIES[str(node.module)]


def _is_of_messages(node: ast.Attribute) -> bool:
    """Whether it is an attribute of a variable that holds a message."""
    root = ast.unparse(node).partition(".")[0].partition("[")[0]
    return (
        root in ("image", "info", "detections", "detection", "one", "bbox", "answer", "result")
        and node.attr != "append"
    )
