"""The heads of the densities other than the paper's, as conf/model describes them."""

import yaml

from phd_exp.cli import conf_folder
from phd_exp.config.targets import build
from phd_exp.geometry import DepthScale
from phd_exp.models.heads import Head

DEPTH = DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0))


def head(model: str) -> Head:
    """The head of a model."""
    node = yaml.safe_load((conf_folder() / "model" / f"{model}.yaml").read_text())["head"]
    return build(node, is_partial=True)(depth=DEPTH)


SHAPED = {name: head(name) for name in ("gaussian", "gaussian_mixture", "decomposed", "student_t")}
