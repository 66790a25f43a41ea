"""Specifications, and a few rendered data sets."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.scenes import Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering import render
from phd_exp.rendering.render import ensure_rendered
from phd_exp.rendering.sampling import sample_scene
from phd_exp.rendering.triangles import Triangles
from tests.support.meshes import solid, write_mesh
from tests.support.renders import N_TEST, N_TRAIN, MakeSpec, contents, copying, written

# A quarter of the sensor and of the focal length: the same pictures, in a moment.
SMALL: dict[str, Any] = {"sensor_size": 56, "f_range": (300.0, 500.0), "samples_per_pixel": 1}
HALF: dict[str, Any] = {"sensor_size": 112, "f_range": (600.0, 1000.0)}


@pytest.fixture(scope="session")
def small_spec(make_spec: MakeSpec) -> DatasetSpec:
    """A data set whose images are cheap."""
    return make_spec(**SMALL)


@pytest.fixture(scope="session")
def scenes(make_spec: MakeSpec) -> list[Scene]:
    """Scenes of three objects in small images."""
    spec = make_spec("occl_scale", sensor_size=40, f_range=(200.0, 300.0))
    return [sample_scene(spec, "train", index) for index in range(12)]


@pytest.fixture(scope="session")
def meshes() -> dict[str, Triangles]:
    """A cylinder of 0.2 m."""
    return {"mesh": solid("cylinder")}


@pytest.fixture(scope="session")
def of_mesh(make_spec: MakeSpec, tmp_path_factory: pytest.TempPathFactory) -> MakeSpec:
    """The data set of a mesh, by default of that cylinder, with some values changed."""
    file = write_mesh(tmp_path_factory.mktemp("mesh") / "part.stl", solid("cylinder"))
    return lambda **changes: make_spec("object", **{"mesh": str(file)} | changes)


@pytest.fixture(scope="session")
def rendered(make_spec: MakeSpec, tmp_path_factory: pytest.TempPathFactory) -> DatasetFolder:
    """Training images and a test image with all that the variants show."""
    folder = DatasetFolder(tmp_path_factory.mktemp("renders") / "occl_scale")
    ensure_rendered(folder, make_spec("occl_scale", **HALF), n_train=6, n_test=1, workers=1)
    return folder


@pytest.fixture(scope="session")
def centred(make_spec: MakeSpec, tmp_path_factory: pytest.TempPathFactory) -> DatasetFolder:
    """Images of full size, with cylinders whose whole silhouette is inside."""
    folder = DatasetFolder(tmp_path_factory.mktemp("centred") / "default")
    ensure_rendered(folder, make_spec(xy_range=0.2), n_train=8, n_test=0, workers=1)
    return folder


@pytest.fixture(scope="session")
def small(small_spec: DatasetSpec, tmp_path_factory: pytest.TempPathFactory) -> DatasetFolder:
    """Training and test images, rendered without interruption by one process."""
    folder = DatasetFolder(tmp_path_factory.mktemp("small") / "default")
    assert ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=1)
    return folder


@pytest.fixture(scope="session")
def small_webp(small_spec: DatasetSpec, tmp_path_factory: pytest.TempPathFactory) -> DatasetFolder:
    """The first samples of `small` as WebP files, rendered in two steps, between which an image is lost."""
    folder = DatasetFolder(tmp_path_factory.mktemp("webp") / "default")
    spec = small_spec.model_copy(update={"image_format": "webp"})
    ensure_rendered(folder, spec, 3, 1, workers=1)
    folder.image_path("train", 2, "webp").unlink()
    ensure_rendered(folder, spec, 5, 2, workers=1)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> DatasetFolder:
    """A data set that does not exist yet."""
    return DatasetFolder(tmp_path / "default")


@pytest.fixture
def copied(small: DatasetFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images come from `small`, not from workers."""
    monkeypatch.setattr(render, "render_all", copying(small))


@pytest.fixture
def complete(small: DatasetFolder, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """The same call completes a folder, here by copies, to the bytes of `small`, and touches no finished image."""

    def complete(folder: DatasetFolder, kept: dict[Path, int]) -> None:
        with monkeypatch.context() as patched:
            patched.setattr(render, "render_all", copying(small))
            ensure_rendered(folder, small.manifest.spec, N_TRAIN, N_TEST)
        assert contents(folder) == contents(small)
        assert kept.items() <= written(folder).items()

    return complete
