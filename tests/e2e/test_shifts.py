"""A finished run is tested on shifted samples, each once, and is not trained again for that."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import phd_exp as package
from phd_exp.build import build_source
from phd_exp.config import check
from phd_exp.records.runs import find_runs
from tests.support.recorded import only_run, stamps

IMAGES = ("noise", "blur", "dark", "bright", "gamma_half", "gamma_two", "jpeg")


def test_shifts_are_recorded_once_without_training_again(own: Callable, tmp_path: Path) -> None:
    assert own("camera=shown").status == 0
    run = only_run(tmp_path / "runs")
    trained = stamps(run)
    assert not run.shifts.exists()
    words = ("camera=shown", "shift=[images,focal_length]")
    outcome = own(*words)
    assert outcome.status == 0, outcome.err
    assert len(find_runs(tmp_path / "runs")) == 1
    recorded = stamps(run)
    assert trained.items() <= recorded.items()
    assert recorded.keys() - trained.keys() == {f"shifts/{name}.parquet" for name in (*IMAGES, "f_wrong")}

    # the tables against the network in Python, on images changed by hand
    predictor, samples = (
        package.load(run.path, trust=["ownnet"]),
        build_source(check(run.config()).data).samples("test"),
    )
    halved = replace(samples, image=(samples.image / 2).round().to(samples.image.dtype))
    for name, batch, factor in (("dark", halved, 1.0), ("f_wrong", samples, 1.05)):
        table = pd.read_parquet(run.shift(name))
        assert list(table) == list(pd.read_parquet(run.predictions))
        f = factor * batch.f
        expected = predictor.predict(predictor.raw(batch.image.numpy(), f), f)
        mode = np.column_stack([table[f"mode_{axis}"] for axis in "xyz"])
        np.testing.assert_allclose(mode, expected.mode.numpy(), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(table["z"], samples.xyz[:, 2].numpy())

    assert "recorded" not in own(*words).out
    assert stamps(run) == recorded
    run.shift("blur").unlink()
    assert own(*words, "evaluation.shifts.dark.images.brightness=0.25").out.count(": recorded") == 2
    changed = {name for name, stamp in stamps(run).items() if recorded[name] != stamp}
    assert changed == {"shifts/blur.parquet", "shifts/dark.parquet"}


@pytest.mark.slow
def test_scenes_are_rendered_beside_the_run_s_own(train: Callable, renders: Path, tmp_path: Path) -> None:
    """Real renders: each has its change, and otherwise the scenes of home."""
    words = ("trainer.max_epochs=1", "logger=none", "shift=[scenes,variants]", "evaluation.n_shifted=3")
    outcome = train(*words, "data=occl")
    assert outcome.status == 0, outcome.err
    run = only_run(tmp_path / "runs")
    home = pd.read_parquet(run.predictions)[:3]
    found = {file.stem: pd.read_parquet(file) for file in run.shifts.iterdir()}
    assert found.keys() == {"short_f", "long_f", "near", "far", "grey", "hidden"} | {
        "default", "occl", "scale", "occl_scale"
    }  # fmt: skip
    for name, table in found.items():
        assert len(table) == 3
        np.testing.assert_array_equal(table["z"] == home["z"], name not in ("near", "far"))
        np.testing.assert_array_equal(table["f"] == home["f"], name not in ("short_f", "long_f"))
    assert found["far"]["z"].between(5, 7).all()
    np.testing.assert_allclose(found["occl"]["mode_z"], home["mode_z"], rtol=1e-5)
    assert (renders / "occl-hidden" / "test").is_dir()
    assert not (renders / "occl-hidden" / "train").is_dir() or not list(
        (renders / "occl-hidden" / "train").glob("*.png")
    )
    assert "recorded" not in train(*words, "data=occl").out
