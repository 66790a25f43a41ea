"""`python -m phd_exp gallery`: the pictures of renders/README.md."""

import sys

import hydra

from phd_exp.cli.folders import named_folders, require_folder
from phd_exp.cli.jobs import plain
from phd_exp.cli.paths import conf_folder
from phd_exp.records.errors import UserError
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.gallery import draw_camera, draw_gallery
from phd_exp.training.config import check_render

VARIANTS = ("default", "occl", "scale", "occl_scale")
INDICES = (0, 3, 6, 8, 12, 14)


def main(arguments: list[str]) -> int:
    """Draw both pictures; returns the exit status."""
    try:
        folder = named_folders("gallery", {"folder": "renders"}, arguments)["folder"]
        require_folder("folder", folder, "make it, or name another")
        specs = [_spec(variant) for variant in VARIANTS]
        draw_gallery(folder / "gallery.jpg", specs, INDICES)
        draw_camera(folder / "camera.png", specs[0], INDICES[4])
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"{folder / 'gallery.jpg'}, {folder / 'camera.png'}")
    return 0


def _spec(variant: str) -> DatasetSpec:
    with hydra.initialize_config_dir(str(conf_folder()), version_base="1.3"):
        config = hydra.compose("render", [f"data={variant}"])
    return check_render(plain(config)).data.spec
