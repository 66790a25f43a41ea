"""Shards render one folder together: in any order, and after any kill, it ends with the bytes of one render."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.errors import DatasetError
from phd_exp.records.processes import held
from phd_exp.records.spec import DatasetSpec, Shard
from phd_exp.rendering import render, sealing
from phd_exp.rendering.render import ensure_rendered
from tests.support.renders import N_TEST, N_TRAIN, contents, journaled, rendering_elsewhere, wait_until

FIRST, SECOND = Shard(0, 2), Shard(1, 2)
Render = Callable[..., bool]


@pytest.fixture
def render_shard(folder: DatasetFolder, small_spec: DatasetSpec, copied: None) -> Render:
    """Render a shard, or everything; the images are copies."""
    return lambda shard=None, n_train=N_TRAIN, n_test=N_TEST: ensure_rendered(
        folder, small_spec, n_train, n_test, shard=shard
    )


def test_one_after_the_other_in_any_order(
    folder: DatasetFolder, small: DatasetFolder, render_shard: Render, capfd: pytest.CaptureFixture[str]
) -> None:
    assert not render_shard(Shard(2, 3))
    assert "shard 2/3 is done; 11 samples of other shards are missing" in capfd.readouterr().err
    assert not render_shard(Shard(2, 3))
    assert "nothing left to render in shard 2/3" in capfd.readouterr().err
    assert not render_shard(Shard(2, 6)), "another count resumes with the same samples"
    assert "nothing left to render in shard 2/6" in capfd.readouterr().err
    assert folder.manifest.splits == {}, "nothing counts as finished before everything is"
    assert not render_shard(Shard(0, 3))
    assert render_shard(Shard(1, 3))
    assert contents(folder) == contents(small)
    assert render_shard(Shard(2, 3))


def test_four_at_once_in_an_empty_folder(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    with ExitStack() as stack:
        racing = [
            stack.enter_context(rendering_elsewhere(folder, small_spec, shard=shard, source=small))
            for shard in (FIRST, SECOND, FIRST, SECOND)
        ]
        said = [process.communicate()[1] for process in racing]
        assert [process.returncode for process in racing] == [0] * 4, said
    assert contents(folder) == contents(small)
    assert sum(text.count(" images of ") for text in said) == 2, "each shard is rendered once"


@pytest.mark.parametrize("shard", [None, FIRST])
def test_an_unsharded_render_waits_for_others_and_repeats_nothing(
    folder: DatasetFolder,
    small: DatasetFolder,
    small_spec: DatasetSpec,
    render_shard: Render,
    shard: Shard | None,
    capfd: pytest.CaptureFixture[str],
) -> None:
    with rendering_elsewhere(folder, small_spec, shard=shard, source=small) as process:
        wait_until(lambda: journaled(folder))
        render_shard()
        process.communicate()
        assert process.returncode == 0
    assert contents(folder) == contents(small)
    said = capfd.readouterr().err
    assert "another process is rendering here; waiting" in said
    assert ("rendering the remaining 8 images" in said) is (shard is not None)


def test_a_shard_of_more_samples_than_the_others_seals_no_gap(
    folder: DatasetFolder, small: DatasetFolder, render_shard: Render
) -> None:
    assert not render_shard(SECOND)
    assert render_shard(FIRST, 6, 2)
    assert folder.manifest.count("train") == 6
    assert render_shard()
    assert contents(folder) == contents(small)


def test_a_kill_while_sealing_loses_nothing(
    folder: DatasetFolder, small: DatasetFolder, render_shard: Render, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a kill at each write of sealing in turn, the next shard finds everything and renders nothing."""
    render_shard(FIRST)
    with held(folder.render_lock, shared=True):  # as if another shard were at work, which would seal
        assert not render_shard(SECOND)
    monkeypatch.setattr(render, "render_all", None)
    whole = sealing.write_atomic
    for survived in range(2):
        written: list[Path] = []

        def dying(path: Path, data: str, survived: int = survived, written: list[Path] = written) -> None:
            if len(written) == survived:
                raise KeyboardInterrupt
            written.append(path)
            whole(path, data)

        monkeypatch.setattr(sealing, "write_atomic", dying)
        with pytest.raises(KeyboardInterrupt):
            render_shard(SECOND)
        assert sealing.missing(sealing.known_samples(folder), {"train": N_TRAIN, "test": N_TEST}) == []
    monkeypatch.setattr(sealing, "write_atomic", whole)
    assert render_shard(SECOND)
    assert contents(folder) == contents(small)


def test_another_data_set_begun_a_moment_ago_is_refused(
    folder: DatasetFolder, small_spec: DatasetSpec, render_shard: Render, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begin_another() -> None:
        folder.cache.mkdir(parents=True, exist_ok=True)
        sealing.begin(folder, small_spec.model_copy(update={"seed": 7}))

    monkeypatch.setattr(render, "require_bpy", begin_another)
    with pytest.raises(DatasetError, match="seed=7, but seed=0 is asked for"):
        render_shard(FIRST)
    assert not any(folder.images(split) for split in SPLITS)
