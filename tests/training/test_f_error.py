"""A focal length that is known within some per cent: the errors that the model receives."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import kstest

import phd_exp as package
from phd_exp.build import build_source
from phd_exp.cli.train import rendered
from phd_exp.config import RunConfig, check
from phd_exp.data.batches import Batch
from phd_exp.data.sources import Part, Source
from phd_exp.evaluation.parquet import read_table
from phd_exp.records.errors import RunError
from phd_exp.records.runs import RunFolder
from phd_exp.training import tables
from phd_exp.training.build import build_data, build_module
from phd_exp.training.cameras import standard_error
from phd_exp.training.predictions import write_parquet
from tests.support.recorded import once

ROWS = torch.arange(8000)


def test_the_errors_are_normal_over_the_samples_of_an_epoch_and_over_the_epochs_of_a_sample() -> None:
    for epoch in (0, 7, 49):
        assert kstest(standard_error(ROWS, epoch), "norm").statistic < 0.01
    for row in (0, 13, 7999):
        over_epochs = torch.stack([standard_error(ROWS[row : row + 1], epoch) for epoch in range(50)])
        assert kstest(over_epochs.flatten(), "norm").statistic < 0.05


def test_the_model_receives_focal_lengths_within_the_error_and_the_labels_stay(composed: Callable) -> None:
    config = check(composed("preset=smoke", "camera.f_error=0.05"))
    module = build_module(config, build_data(config))
    n = 64
    xyz = torch.tensor([0.1, 0.0, 4.0]).expand(n, 3)
    batch = Batch(torch.zeros(n, 8, 8, 3, dtype=torch.uint8), xyz, torch.full((n,), 1500.0), 8.0, torch.arange(n))
    known = module.eval().camera(batch).f
    assert (known / 1500).log().std() == pytest.approx(0.05, rel=0.15)
    assert (known / 1500).log().mean() == pytest.approx(0, abs=0.01)
    assert torch.equal(known, module.eval().camera(batch).f)
    assert torch.equal(batch.camera.f, torch.full((n,), 1500.0))
    shifted = batch.select(torch.arange(32, n))
    assert torch.equal(module.camera(shifted).f, known[32:])  # by sample, in whatever batch


F_ERROR = 0.05
WORDS = (
    f"camera.f_error={F_ERROR}", "evaluation.eight_views=true", "shift=focal_length", "trainer.max_epochs=1",
    "trainer.precision=bfloat16",  # on any CPU: what is recorded and predicted is float32 all the same
)  # fmt: skip


@pytest.fixture(scope="module")
def run(run_in: Callable, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run with all further tables; those of several cameras are of the test samples."""

    def make(path: Path) -> None:
        run = run_in(path, *WORDS)
        config = check(run.config())
        tables.record_tables(run, config, partial(rendered, cores=1))
        source = build_source(config.data)
        tables.record(run, config, run.views, source, tables.origin_of(run, config))

    return RunFolder(once(tmp_path_factory, "run with wrong focal lengths", make))


def config_and_source(run: RunFolder) -> tuple[RunConfig, Source]:
    config = check(run.config())
    return config, build_source(config.data)


@pytest.mark.parametrize(
    ("name", "part", "views", "shift"),
    [
        ("predictions.parquet", "test", 1, 1.0),
        ("held_out.parquet", "held_out", 1, 1.0),
        ("eight_views_held_out.parquet", "held_out", 8, 1.0),
        ("eight_views_test.parquet", "test", 8, 1.0),
        ("views.parquet", "test", 1, 1.0),
        ("shifts/f_wrong.parquet", "test", 1, 1.05),
    ],
)
def test_every_record_predicts_with_the_focal_lengths_of_the_module(
    run: RunFolder, name: str, part: Part, views: int, shift: float
) -> None:
    """The same wrong focal length for the same sample, and the table has it."""
    config, source = config_and_source(run)
    table, samples, predictor = read_table(run.path / name), source.samples(part), package.load(run.path, views=views)
    module = build_module(config, build_data(config)).eval()
    f = shift * module.camera(samples).f
    assert not torch.isclose(f, shift * samples.f, rtol=1e-3).any()
    np.testing.assert_allclose(table["f"] / table["S"], f / samples.S, rtol=1e-6)
    expected = predictor.predict(predictor.raw(samples.image.numpy(), f), f)
    mode = np.column_stack([table[f"mode_{axis}"] for axis in "xyz"])
    np.testing.assert_allclose(mode, expected.mode.numpy(), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(table["z"], samples.xyz[:, 2].numpy())


def test_tables_of_exact_focal_lengths_are_recorded_again(run: RunFolder, tmp_path: Path) -> None:
    """An earlier version made such tables, on which a guarantee would be too narrow."""
    old = RunFolder(Path(shutil.copytree(run.path, tmp_path / "old")))
    config, source = config_and_source(old)
    exact = {"f_factor": torch.ones(4), "row": torch.arange(4)}
    files = old.eight_views["held_out"], old.views
    for file in files:
        table = {
            name: torch.from_numpy(column[:4]) for name, column in read_table(file).items() if name != "file_name"
        }
        write_parquet(file, table | exact, {})
    with pytest.raises(RunError, match=r"views\.parquet: recorded with exact focal lengths, .*records it again"):
        tables.require_received(old.views, config)
    tables.record_eight_views(old, config, source)
    again, right = (read_table(one.eight_views["held_out"]) for one in (old, run))
    np.testing.assert_array_equal(again["f"], right["f"])
    tables.require_received(
        old.views, config.model_copy(update={"camera": config.camera.model_copy(update={"f_error": 0.0})})
    )
