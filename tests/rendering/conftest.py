"""Specifications, and a few real images of each variant, rendered once."""

from collections.abc import Callable
from typing import Any

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.render import ensure_rendered

VARIANTS = ("default", "occl", "scale", "occl_scale")
# A quarter of the sensor and of the focal length: the same pictures, in a moment.
SMALL: dict[str, Any] = {"sensor_size": 56, "f_range": (300.0, 500.0), "samples_per_pixel": 1}


@pytest.fixture(scope="session")
def specs(make_spec: Callable[..., DatasetSpec]) -> dict[str, DatasetSpec]:
    """The four variants."""
    return {variant: make_spec(variant) for variant in VARIANTS}


@pytest.fixture(scope="session")
def small_spec(make_spec: Callable[..., DatasetSpec]) -> DatasetSpec:
    """A data set whose images cost next to nothing."""
    return make_spec(**SMALL)


@pytest.fixture(scope="session")
def rendered(
    specs: dict[str, DatasetSpec], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, DatasetFolder]:
    """Five training images and one test image of each variant, by two processes."""
    root = tmp_path_factory.mktemp("renders")
    folders = {variant: DatasetFolder(root / variant) for variant in specs}
    for variant, folder in folders.items():
        ensure_rendered(folder, specs[variant], n_train=5, n_test=1, workers=2)
    return folders


@pytest.fixture(scope="session")
def small(small_spec: DatasetSpec, tmp_path_factory: pytest.TempPathFactory) -> DatasetFolder:
    """Twelve training and four test images, rendered without interruption by one process."""
    folder = DatasetFolder(tmp_path_factory.mktemp("small") / "default")
    ensure_rendered(folder, small_spec, n_train=12, n_test=4, workers=1)
    return folder


@pytest.fixture(scope="session")
def small_webp(small_spec: DatasetSpec, tmp_path_factory: pytest.TempPathFactory) -> DatasetFolder:
    """The first samples of `small` as WebP files."""
    folder = DatasetFolder(tmp_path_factory.mktemp("webp") / "default")
    ensure_rendered(folder, small_spec.model_copy(update={"image_format": "webp"}), 5, 2, workers=1)
    return folder
