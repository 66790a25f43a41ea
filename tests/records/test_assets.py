"""The user's files are identified by their contents and refused before Blender reads them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from phd_exp.config import check_render
from phd_exp.records.assets import mesh_asset
from phd_exp.records.dataset import DatasetFolder, Manifest
from phd_exp.records.errors import ConfigError, DatasetError
from tests.support.meshes import solid, write_mesh
from tests.support.renders import RENDER

PART = "data.mesh=part.glb"
STANDING = (PART, "data.upright=true", "data.ground=true")


@pytest.fixture
def refused(composed: Callable[..., dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable:
    """The line that refuses a data set of a mesh."""
    monkeypatch.chdir(tmp_path)
    write_mesh(Path("part.glb"), solid("cube"))
    Path("text.glb").write_bytes(b"not a mesh")
    with open("large.stl", "wb") as stream:
        stream.truncate(84 + 50 * 10_000_000)
    Path("few").mkdir()
    Path("few", "a.jpg").touch()

    def line(*overrides: str) -> str:
        with pytest.raises(ConfigError) as error:
            check_render(composed("data=object", *overrides) | RENDER)
        assert "\n" not in str(error.value)
        return str(error.value)

    return line


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ((), "data.mesh: got ''; expected a file of a mesh: .glb, .gltf, .obj, .ply, .stl"),
        (("data.mesh=part.step",), "data.mesh: got 'part.step'; expected a file of a mesh"),
        (("data.mesh=none.glb",), "data.mesh: got 'none.glb'; cannot be used (No such file or directory); give"),
        (("data.mesh=text.glb",), "data.mesh: got 'text.glb'; cannot be read as .glb"),
        ((PART, "data.ignore=[meshes]"), "data.ignore.0: got 'meshes'; expected to be 'materials'"),
        (("data.mesh=large.stl",), "500 MB; expected at most 128 MB); simplify it"),
        ((PART, "data.backdrops=few"), "data.backdrops: got 'few'; expected a folder with at least 4"),
        ((PART, "data.reference=middle"), "data.reference: got 'middle'; expected origin, centroid"),
        ((PART, "data.unit=0"), "data.unit: got 0; expected to be greater than 0"),
        ((PART, "data.distractors=4"), "distractors: got 4; expected at most 3"),
        ((PART, "data.distractors=1", "data.views=2"), "views: got 2 with distractors or copies"),
        ((PART, "data.occluders=true"), "occluders: for the cylinder alone; expected data.distractors=2"),
        ((PART, "data.pitch_range=[-91,0]"), "data.pitch_range.0: got -91; expected to be greater than or equal"),
        (
            (*STANDING, "data.pitch_range=[5,30]"),
            "ground: got upright=True, resting=False, views=1, pitch_range=[5.0, 30.0]; "
            "expected upright or resting, views=1, and pitch_range above 5.33 degrees",
        ),
        ((PART, "data.ground=true"), "got upright=False, resting=False, views=1"),
        ((PART, "data.upright=true", "data.resting=true"), "upright and resting: different laws of rotations"),
        (("data=default", "+data.unit=2.0"), "unit: for meshes alone; expected data=object data.mesh=FILE"),
    ],
)
def test_bad_values_are_one_line(refused: Callable, overrides: tuple[str, ...], message: str) -> None:
    assert message in refused(*overrides)


def test_a_data_set_of_another_mesh_is_refused_by_name(make_spec: Callable, tmp_path: Path) -> None:
    specs = []
    for shape in ("cube", "sphere"):
        write_mesh(tmp_path / f"{shape}.glb", solid(shape))
        specs.append(make_spec(mesh=mesh_asset(tmp_path / f"{shape}.glb")))
    folder = DatasetFolder(tmp_path / "object")
    folder.root.mkdir()
    folder.write_manifest(Manifest(generator=1, renderer="a path tracer", spec=specs[0], splits={}))
    with pytest.raises(DatasetError, match=r"mesh=cube\.glb .*mesh=sphere\.glb .* another data\.variant") as refused:
        folder.require(specs[1])
    assert len(str(refused.value)) < len(str(tmp_path)) + 250
