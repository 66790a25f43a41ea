"""`python -m phd_exp gallery`: the pictures of renders/README.md."""

import sys
from pathlib import Path

import hydra
from omegaconf import OmegaConf

from phd_exp.cli.paths import conf_folder
from phd_exp.records.errors import UserError
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.gallery import draw_camera, draw_gallery

VARIANTS = ("default", "occl", "scale", "occl_scale")
INDICES = (0, 3, 6, 8, 12, 14)


def main(arguments: list[str]) -> int:
    try:
        folder = _folder(arguments)
        specs = [_spec(variant) for variant in VARIANTS]
        draw_gallery(folder / "gallery.jpg", specs, INDICES)
        draw_camera(folder / "camera.png", specs[0], INDICES[4])
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{folder / 'gallery.jpg'}, {folder / 'camera.png'}")
    return 0


def _folder(arguments: list[str]) -> Path:
    """The folder named by `folder=DIR`, or `renders`. Raises UserError for anything else."""
    folder = Path("renders")
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key != "folder" or not value:
            raise UserError(f"{argument}: gallery takes folder=DIR and nothing else")
        folder = Path(value)
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; make it, or name another by folder=DIR")
    return folder


def _spec(variant: str) -> DatasetSpec:
    with hydra.initialize_config_dir(str(conf_folder()), version_base="1.3"):
        data = hydra.compose("config", [f"data={variant}"]).data
    values = OmegaConf.to_container(data)
    assert isinstance(values, dict)
    return DatasetSpec(
        **{str(key): value for key, value in values.items() if key in DatasetSpec.model_fields}
    )
