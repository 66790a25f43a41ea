"""Scenes and labels have the same bits on every processor: neither BLAS nor numpy's vector code computes them."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import phd_exp
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.masks import clearing, mask
from phd_exp.rendering.triangles import NO_MESHES
from tests.rendering.test_boxes import CAMERA, FISHEYE
from tests.support.meshes import solid
from tests.support.renders import ROOT, MakeSpec, described

MOVING = {"camera_speed": 0.3, "camera_turn": 8.0, "frames": 3}
LYING = {"ground": True, "pitch_range": (20.0, 40.0), "copies": 2}
VECTORISED = {"exp", "log", "tan", "power"}  # by numpy 1.26 with AVX-512: other last bits than the C library's
PRODUCTS = {"dot", "vdot", "inner", "matmul", "einsum", "tensordot", "apply"}  # apply: of a Rotation of scipy


def records(specs: list[str]) -> str:
    """The records of the first samples of specifications (JSON), and what is drawn from them."""
    lines = []
    for spec in map(DatasetSpec.model_validate_json, specs):
        meshes = {"mesh": solid("cylinder")} if spec.mesh else NO_MESHES
        for index in range(2):
            record = described(spec, "train", index, meshes)
            lines.append(f"{record.model_dump_json()} {mask(record, meshes).sum()} {clearing(record, meshes).sum()}")
    return "\n".join(lines)


def test_records_are_the_same_with_other_kernels_of_blas(make_spec: MakeSpec, of_mesh: MakeSpec) -> None:
    specs = [
        make_spec("multiview", occluders=True),
        make_spec("sequence", views=2, view_angle_range=(20.0, 60.0), half_hidden=True, frames=2),
        make_spec("sequence", occluders=True, **MOVING),
        of_mesh(upright=True, **LYING),
        of_mesh(resting=True, looks="varied", distractors=2, **LYING),
        of_mesh(front=(0.0, 0.0, 1.0), scale_range=(0.5, 1.0)),
        *(of_mesh(camera=camera, z_range=(0.5, 1.5)) for camera in (CAMERA, FISHEYE)),
    ]
    lines = [spec.model_dump_json() for spec in specs]
    script = "import sys; from tests.rendering.test_processors import records; print(records(sys.argv[1:]))"
    other = subprocess.run(
        [sys.executable, "-c", script, *lines],
        env=os.environ | {"OPENBLAS_CORETYPE": "Prescott"},
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert other.stdout.rstrip("\n").splitlines() == records(lines).splitlines()


def is_forbidden(node: ast.AST) -> bool:
    match node:
        case ast.BinOp(op=ast.MatMult()):
            return True
        case ast.Attribute(value=ast.Name(id="np"), attr=name) if name in VECTORISED:
            return True
        case ast.Call(func=ast.Attribute(attr="norm"), keywords=[]):  # without an axis it is a product
            return True
        case ast.Attribute(value=ast.Attribute(attr="linalg"), attr=name):
            return name != "norm"
        case ast.Attribute(attr=name):
            return name in PRODUCTS
    return False


@pytest.mark.parametrize("folder", ["optics", "rendering"])
def test_only_sums_in_a_fixed_order_are_used(folder: str) -> None:
    """Whatever kernels the BLAS of this machine has."""
    files = Path(phd_exp.__file__).with_name(folder).glob("*.py")
    nodes = [(file.name, node) for file in files for node in ast.walk(ast.parse(file.read_text()))]
    assert [(name, node.lineno) for name, node in nodes if is_forbidden(node)] == []
