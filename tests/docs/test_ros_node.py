"""The node of the guide to ROS 2, which cannot run here: its syntax and its names."""

import ast
import subprocess
import sys

import pytest

from phd_exp.inference.deployed import OfPhotographs
from phd_exp.inference.onnx import DESCRIPTIONS
from phd_exp.records.messages import typestore
from tests.docs.pages import DOCS, blocks

(TEXT,) = (block.text for block in blocks(DOCS / "guides" / "ros.md") if block.file)
TREE = ast.parse(TEXT)
CALLS = [node for node in ast.walk(TREE) if isinstance(node, ast.Call)]


def test_the_node_has_no_undefined_names() -> None:
    words = ["check", "--isolated", "--no-cache", "--select=E,F", "--line-length=118", "-"]
    done = subprocess.run([sys.executable, "-m", "ruff", *words], input=TEXT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_the_node_uses_inputs_and_outputs_of_the_exported_file() -> None:
    (given,) = (node for node in ast.walk(TREE) if isinstance(node, ast.Dict))
    assert [ast.literal_eval(key) for key in given.keys if key] == list(OfPhotographs.inputs)
    (call,) = (node for node in CALLS if ast.unparse(node.func).endswith(".run"))
    assert set(ast.literal_eval(call.args[0])) <= DESCRIPTIONS.keys()


def test_the_node_makes_messages_with_fields_that_exist() -> None:
    pytest.importorskip("rosbags", reason="needs the extra `ros`")
    known = {kind: {name for name, _ in fields} for kind, (_, fields) in typestore().fielddefs.items()}
    imports = [node for node in ast.walk(TREE) if isinstance(node, ast.ImportFrom) and ".msg" in (node.module or "")]
    kinds = {one.name: f"{str(node.module).replace('.', '/')}/{one.name}" for node in imports for one in node.names}
    made = [node for node in CALLS if isinstance(node.func, ast.Name) and node.func.id in kinds]
    assert made
    for call in made:
        assert {keyword.arg for keyword in call.keywords} <= known[kinds[call.func.id]], ast.unparse(call)
