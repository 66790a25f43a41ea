"""The scene of a run's page: which image, and what it has in space."""

from pathlib import Path

import numpy as np
import pytest
import torch

from phd_exp.evaluation.parquet import Arrays, read_table
from phd_exp.records.errors import RunError
from phd_exp.reports.gallery import distribution_of
from phd_exp.reports.scene import LEVELS, first_scene, scene_traces
from tests.support.synthetic import write_run


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Arrays:
    return read_table(write_run(tmp_path_factory.mktemp("run"), n=30).predictions)


def test_the_first_image_is_chosen_whatever_its_error(table: Arrays) -> None:
    scene = first_scene(table)
    assert scene is not None
    assert scene.name == table["file_name"][0]
    backwards = first_scene({name: column[::-1] for name, column in table.items()})
    assert backwards is not None
    assert backwards.name == table["file_name"][-1]


def test_its_surfaces_have_their_levels_and_its_edges_are_those_of_the_image(table: Arrays) -> None:
    scene = first_scene(table)
    row = {name: column[0] for name, column in table.items()}
    distribution = distribution_of(row)
    assert scene is not None
    assert distribution is not None
    for level, (vertices, triangles) in zip(LEVELS, scene.regions, strict=True):
        np.testing.assert_allclose(distribution.level(torch.tensor(vertices).double()), level, atol=0.02)
        assert set(np.ravel(triangles)) == set(range(len(vertices)))
    corners, half = np.array(scene.corners), row["S"] / 2
    pixels = half + row["f"] * corners[:, :2] / corners[:, 2:]
    np.testing.assert_allclose(pixels, [[0, 0], [2 * half, 0], [2 * half, 2 * half], [0, 2 * half]], atol=0.01)
    np.testing.assert_allclose(scene.truth, [row[axis] for axis in "xyz"], rtol=1e-4)
    close = [trace["name"] for trace in scene_traces(scene) if trace["meta"]["close"]]
    assert close == ["50 % region", "90 % region", "true position", "mode"]


def test_without_a_density_or_a_position_there_is_none(table: Arrays, tmp_path: Path) -> None:
    assert first_scene(read_table(write_run(tmp_path, model="mae_vz", n=30).predictions)) is None
    for name in ("z", "a"):
        assert first_scene(table | {name: np.full_like(table[name], np.nan)}) is None
    with pytest.raises(RunError, match="mode_z"):
        first_scene({name: column for name, column in table.items() if name != "mode_z"})
