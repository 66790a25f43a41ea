"""An object from its mesh to a run record and back by `predict`."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from phd_exp.records.dataset import DatasetFolder
from tests.support.meshes import solid, write_mesh
from tests.support.recorded import only_run
from tests.support.untrained import read_lines

SMALL = ("preset=smoke", "data=object", "data.sensor_size=64", "data.f_range=[343,571]", "data.samples_per_pixel=1")
FEW = ("data.n_train=4", "data.n_held_out=0", "data.n_test=2", "data.workers=1")


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_mesh(tmp_path_factory.mktemp("part") / "part.glb", solid("cylinder"), per_metre=1000)


def test_an_object_is_rendered_masked_and_verified(phd_exp: Callable, part: Path, tmp_path: Path) -> None:
    """A wrong unit leaves nothing behind that would refuse the right one."""
    words = ("render", *SMALL, *FEW, f"data.mesh={part}", "data.backdrops=null", "data.xy_range=0.3")
    wrong = phd_exp(*words)
    assert (wrong.status, wrong.err.count("error: ")) == (1, 1)
    assert re.search("longest side is 200 m, .* set data.unit=0.001", wrong.err)
    made = phd_exp(*words, "data.unit=0.001", f"masks={tmp_path / 'masks'}")
    assert made.status == 0, made.err
    checked = phd_exp(*words, "data.unit=0.001", "verify=true", "rerender=2")
    assert (checked.status, "all 6 samples are as they were rendered" in checked.out) == (0, True), checked.err
    folder = DatasetFolder(tmp_path / "renders" / "object")
    for record in folder.records("train"):
        mask = np.asarray(Image.open(tmp_path / "masks" / "train" / record.file_name))
        assert mask.sum() > 20
        image = np.asarray(Image.open(folder.image_path("train", record.index))).astype(float)
        behind = np.quantile(image[~mask].mean(axis=-1), [0.02, 0.98])  # without the pixels at the edge of the object
        contrast = np.abs(image[mask].mean(axis=0) - image[~mask].mean(axis=0)).max()
        assert np.ptp(behind) < 100 < 3 * contrast
    write_mesh(part, solid("cube"), per_metre=1000)
    changed = phd_exp(*words, "data.unit=0.001")
    write_mesh(part, solid("cylinder"), per_metre=1000)
    assert (changed.status, "holds a data set with mesh=" in changed.err) == (1, True)


@pytest.mark.usefixtures("undrawn")
def test_a_run_on_views_of_boxes_predicts_boxes(phd_exp: Callable, part: Path, tmp_path: Path) -> None:
    """One command renders and trains; the depth scale follows from the rendered views."""
    quick = ("recipe=strong", "data.batch_size=4", "data.image_size=64", "trainer.threads=1")
    camera = ("data.f=500", "data.width=640", "data.height=480", "data.z_range=[0.6,1.2]")
    words = ("preset=smoke", "data=object", "data.sensor_size=64", "data.samples_per_pixel=1", *FEW, *quick, *camera)
    words += (f"data.mesh={part}", "data.unit=0.001", "logger=none", "trainer.progress_bar=false")
    done = phd_exp(*words, "trainer.max_epochs=1", "data.looks=varied")
    assert done.status == 0, done.err
    run, records = only_run(tmp_path / "runs"), DatasetFolder(tmp_path / "renders" / "object").records("train", 4)
    ratio = [record.z / record.f for record in records]
    assert run.constants()["D"] == pytest.approx((max(ratio) / min(ratio)) ** 0.5)
    Image.new("RGB", (640, 480), (90, 120, 90)).save(tmp_path / "photo.png")
    mesh = part.rename(tmp_path / "elsewhere.glb")  # predictions need the images alone
    for words, n in ((("image=photo.png", "f=500", "box=10,20,80,90"), 1), (("folder=renders/object/test",), 2)):
        answer = phd_exp("predict", f"run={run.path}", *words)
        assert (answer.status, answer.err) == (0, "")
        assert len(read_lines(answer.out)) == n
    mesh.rename(part)
