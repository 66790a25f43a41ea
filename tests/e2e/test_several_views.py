"""A run on single views is tried on several views of each scene, once, and is not trained again for that."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch

from phd_exp.evaluation.several_views import read_sequences
from phd_exp.fusion import Pose
from phd_exp.records import scenes
from phd_exp.records.runs import RunFolder, find_runs
from tests.e2e.conftest import QUICKER
from tests.support.recorded import only_run, stamps


def asked(n: int) -> tuple[str, ...]:
    return (*QUICKER, "evaluation.multiview.views=2", f"evaluation.multiview.scenes={n}")


def test_views_are_recorded_once_and_the_run_stays_as_it_was(train: Callable, run: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(run.path.parents[3], tmp_path / "runs")
    run = only_run(tmp_path / "runs")
    trained = stamps(run)
    assert "views.parquet" not in trained
    outcome = train(*asked(4))
    assert outcome.status == 0, outcome.err
    assert "views.parquet: 4 scenes seen by 2 cameras each" in outcome.out
    assert len(find_runs(tmp_path / "runs")) == 1
    recorded = stamps(run)
    assert trained.items() <= recorded.items()

    table, single = pd.read_parquet(run.views), pd.read_parquet(run.predictions)
    assert table["scene"].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert table["view"].tolist() == [0, 1] * 4
    assert table.columns.to_series().isin(single.columns).sum() == len(single.columns)
    # the first view is what the data set of single views shows
    first = table[table["view"] == 0].reset_index(drop=True)
    for column in ("x", "z", "f", "mode_x", "mode_z", "a", "nll"):
        np.testing.assert_allclose(first[column], single[column][:4], rtol=1e-5, atol=1e-6)
    poses = [
        scenes.Pose(rotation=tuple(row[:4]), translation=tuple(row[4:]))
        for row in table.filter(like="pose_").to_numpy().tolist()
    ]
    xyz = Pose.from_scene(poses).into_world(torch.tensor(table[["x", "y", "z"]].to_numpy())).reshape(4, 2, 3)
    np.testing.assert_allclose(xyz[:, 0], xyz[:, 1], atol=1e-5)

    again = train(*asked(4))
    assert again.status == 0
    assert "views.parquet" not in again.out
    assert stamps(run) == recorded

    # another number of scenes, another record; another data set, none
    assert "2 scenes" in train(*asked(2)).out
    assert pq.read_metadata(run.views).num_rows == 4
    before = run.views.read_bytes()
    refused = train(*asked(2), "evaluation.multiview.views=3")
    assert refused.status == 1
    assert "holds a data set with views=2, but views=3 is asked for" in refused.err
    assert run.views.read_bytes() == before
    untrained = train(*asked(2), "evaluation.multiview.views=3", "seed=1")
    assert (untrained.status, untrained.err) == (1, refused.err)
    assert len(find_runs(tmp_path / "runs")) == 1, "found before the training"


def test_sequences_from_two_cameras_are_recorded(train: Callable, run: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(run.path.parents[3], tmp_path / "runs")
    (run,) = find_runs(tmp_path / "runs")
    words = (*QUICKER, "evaluation.sequences=[[2,3]]", "evaluation.sequence_cameras=2")
    outcome = train(*words)
    assert outcome.status == 0, outcome.err
    assert "3.parquet: 2 sequences of 3 frames from two cameras" in outcome.out
    held_out, _ = read_sequences(run.sequence(3, held_out=True))
    first, second = read_sequences(run.sequence(3, held_out=False))
    assert (held_out.n, first.n, first.views) == (1, 2, 3)
    torch.testing.assert_close(first.columns["time"][0], torch.arange(3).double() / 30)
    same = (one.pose.into_world(one.xyz) for one in (first, second))
    torch.testing.assert_close(*same, rtol=0, atol=1e-5)
    single = pd.read_parquet(run.predictions)  # the first frame of the first camera is an image of its test set
    np.testing.assert_allclose(first.columns["mu_z"][:, 0], single["mu_z"][:2], rtol=1e-5)
    assert "3.parquet" not in train(*words).out


@pytest.mark.slow
def test_a_run_that_lacks_its_views_counts_as_begun(train: Callable, tmp_path: Path) -> None:
    words = ("-m", "experiment=fusion", *asked(1))
    first = train(*words)
    assert first.status == 0, first.err
    assert "1 of them finished already" in train(*words).out
    run = only_run(tmp_path / "runs")
    run.views.write_bytes(b"torn")
    outcome = train(*words)
    assert "views.parquet: 1 scene seen by 2" in outcome.out
    run.views.unlink()
    assert "1 job, 0 of them finished already" in train(*words).out
    assert json.loads(run.status_file.read_text())["state"] == "finished"
