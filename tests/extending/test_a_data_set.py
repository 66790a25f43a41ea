"""A data set of one's own is a file that says in what it differs; in the repository it would lie in `conf/data/`."""

from collections.abc import Callable
from pathlib import Path

from omegaconf import OmegaConf

from phd_exp.cli.jobs import plain
from phd_exp.config import check_render
from phd_exp.rendering.sampling import sample_scene

FAR = """# Cylinders twice as far away.
defaults: [default, _self_]
variant: far
z_range: [6.0, 10.0]
"""


def test_a_file_makes_a_data_set(phd_exp: Callable, tmp_path: Path) -> None:
    (tmp_path / "mine" / "data").mkdir(parents=True)
    (tmp_path / "mine" / "data" / "far.yaml").write_text(FAR)
    outcome = phd_exp("render", "--config-dir=mine", "data=far", "preset=smoke", "--cfg", "job", "--resolve")
    spec = check_render(plain(OmegaConf.create(outcome.out))).data.spec
    scenes = [sample_scene(spec, "train", index) for index in range(20)]
    assert spec.variant == "far"
    assert all(6 <= cylinder.position[2] <= 10 for scene in scenes for cylinder in scene.objects)
