"""`python -m phd_exp render`: render a data set, its missing samples or a shard of them; or verify it."""

from typing import Any

from phd_exp.cli.jobs import Job, launch
from phd_exp.cli.train import rendered
from phd_exp.config import check_render
from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import ConfigError, RenderError
from phd_exp.records.processes import announce
from phd_exp.rendering.bop import write_bop
from phd_exp.rendering.finished import require_elsewhere, verify
from phd_exp.rendering.masks import ensure_drawn, meshes_of, write_masks


def main(words: list[str]) -> int:
    """Render once, or (-m) every combination; returns the exit status."""
    return launch(Job(task), words, "render")


def task(config: dict[str, Any], overrides: list[str], cores: int) -> None:
    """Run one job of rendering."""
    checked = check_render(config)
    data, folder = checked.data, DatasetFolder(checked.data.folder)
    require_elsewhere(folder, masks=checked.masks, bop=checked.bop)
    if checked.bop and data.spec.image_format == "webp":
        raise ConfigError("data.image_format: got webp; BOP has no such images; expected png or jpeg, or no bop=")
    if checked.verify:
        n = verify(folder, data.spec, checked.rerender)
        print(f"{folder.root}: all {n} samples are as they were rendered")
        return
    finished = [rendered(one, cores=cores, shard=checked.shard) for one in checked.rendered]
    if not all(finished):
        return  # other shards are missing
    try:
        ensure_drawn(folder, data.spec, data.n_training_split)
    except RenderError as error:  # a data set that cannot be written is whole without masks
        announce(f"note: {error}; recipe=strong needs masks")
    print(f"{folder.root}: {data.n_training_split} training and {data.n_test} test samples are there")
    if checked.masks or checked.bop:
        meshes = meshes_of(data.spec)
    if checked.masks:
        print(f"{checked.masks}: {write_masks(folder, checked.masks, meshes)} masks")
    if checked.bop:
        print(f"{checked.bop}: {write_bop(folder, checked.bop, meshes)} images as BOP")
