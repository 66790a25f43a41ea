"""Shards render one folder together: whoever starts, ends or dies when, it ends with the bytes of one render."""

import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.errors import DatasetError
from phd_exp.records.shards import Shard
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering import render, sealing
from phd_exp.rendering.locks import held, held_if_free
from phd_exp.rendering.render import ensure_rendered, render_shard
from tests.rendering.folders import PATIENCE, contents, in_a_process, wait_until

N_TRAIN, N_TEST = 12, 4
FIRST, SECOND = Shard(0, 2), Shard(1, 2)


@pytest.fixture
def folder(tmp_path: Path) -> DatasetFolder:
    return DatasetFolder(tmp_path / "default")


def journaled(folder: DatasetFolder, shard: Shard | None) -> int:
    path = folder.journal_path("train", shard)
    return path.read_bytes().count(b"\n") if path.exists() else 0


@contextmanager
def elsewhere(folder: DatasetFolder, spec: DatasetSpec, shard: Shard) -> Iterator[subprocess.Popen[str]]:
    """A shard in a process of its own."""
    call = f"render_shard(folder, spec, {N_TRAIN}, {N_TEST}, {shard!r}, workers=1)"
    with in_a_process(call, folder, spec, stderr=subprocess.PIPE, text=True) as process:
        yield process


def test_one_after_the_other_in_any_order(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, capfd: pytest.CaptureFixture[str]
) -> None:
    shards = [Shard(index, 3) for index in (2, 0, 1)]
    assert not render_shard(folder, small_spec, N_TRAIN, N_TEST, shards[0], workers=1)
    assert "shard 2/3 is done; 11 samples of other shards are missing" in capfd.readouterr().err
    assert not render_shard(folder, small_spec, N_TRAIN, N_TEST, shards[0], workers=1)
    assert "nothing left to render in shard 2/3" in capfd.readouterr().err
    assert folder.manifest.splits == {}, "nothing is finished before all of it is"
    assert not render_shard(folder, small_spec, N_TRAIN, N_TEST, shards[1], workers=1)
    assert render_shard(folder, small_spec, N_TRAIN, N_TEST, shards[2], workers=1)
    assert contents(folder) == contents(small)
    assert render_shard(folder, small_spec, N_TRAIN, N_TEST, shards[0])


def test_four_at_once_in_an_empty_folder(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    with ExitStack() as stack:
        racing = [
            stack.enter_context(elsewhere(folder, small_spec, shard))
            for shard in (FIRST, SECOND, FIRST, SECOND)
        ]
        said = [process.communicate(timeout=PATIENCE)[1] for process in racing]
        assert [process.returncode for process in racing] == [0] * 4, said
    assert contents(folder) == contents(small)
    began = [line for text in said for line in text.splitlines() if line.startswith("rendering ")]
    assert sum("images of" in line for line in began) == 2, "each shard is rendered once"


@pytest.mark.slow
def test_a_killed_shard_loses_what_is_in_flight_and_no_more(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    with elsewhere(folder, small_spec, FIRST) as process:
        wait_until(lambda: journaled(folder, FIRST) >= 2)
        process.kill()
        process.wait()
    done = journaled(folder, FIRST)
    assert done < N_TRAIN // 2
    with held_if_free(folder.render_lock) as free:
        assert free, "the system drops the locks of the dead"
    kept = {path: path.stat().st_mtime_ns for path in folder.split_folder("train").glob("*.png")}
    assert not render_shard(folder, small_spec, N_TRAIN, N_TEST, SECOND, workers=1)
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=1)
    assert contents(folder) == contents(small)
    assert sum(path.stat().st_mtime_ns == then for path, then in kept.items()) >= done


@pytest.mark.slow
def test_another_count_goes_on_with_what_is_there(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, capfd: pytest.CaptureFixture[str]
) -> None:
    render_shard(folder, small_spec, N_TRAIN, N_TEST, FIRST, workers=1)
    capfd.readouterr()
    assert not render_shard(folder, small_spec, N_TRAIN, N_TEST, Shard(0, 4), workers=1)
    assert "nothing left to render in shard 0/4" in capfd.readouterr().err
    ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=1)
    assert "rendering the remaining 8 images" in capfd.readouterr().err
    assert contents(folder) == contents(small)


def test_an_unsharded_render_waits_for_shards_and_repeats_nothing(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, capfd: pytest.CaptureFixture[str]
) -> None:
    with elsewhere(folder, small_spec, FIRST) as process:
        wait_until(lambda: journaled(folder, FIRST) >= 1)
        ensure_rendered(folder, small_spec, N_TRAIN, N_TEST, workers=1)
        assert process.wait() == 0
    assert contents(folder) == contents(small)
    said = capfd.readouterr().err
    assert "another process is rendering here; waiting" in said
    assert "rendering the remaining 8 images" in said


@pytest.mark.slow
def test_who_renders_more_than_others_seals_no_gap(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    assert not render_shard(folder, small_spec, 12, 4, SECOND, workers=1)
    assert render_shard(folder, small_spec, 6, 2, FIRST, workers=1)
    assert folder.manifest.count("train") == 6
    ensure_rendered(folder, small_spec, 6, 2)
    ensure_rendered(folder, small_spec, 12, 4, workers=1)
    assert contents(folder) == contents(small)


def test_a_kill_while_sealing_loses_nothing(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each of the writes of sealing in turn, the next shard finds everything and renders nothing."""
    render_shard(folder, small_spec, N_TRAIN, N_TEST, FIRST, workers=1)
    render_shard(folder, small_spec, 1, 1, SECOND, workers=1)
    # all is known from here on, and nothing is sealed
    monkeypatch.setattr("phd_exp.rendering.render.held_if_free", lambda _: held_by_another())
    assert not render_shard(folder, small_spec, N_TRAIN, N_TEST, SECOND, workers=1)
    monkeypatch.undo()
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
            render_shard(folder, small_spec, N_TRAIN, N_TEST, SECOND)
        assert sealing.missing(sealing.known_samples(folder), {"train": N_TRAIN, "test": N_TEST}) == 0
    monkeypatch.setattr(sealing, "write_atomic", whole)
    assert render_shard(folder, small_spec, N_TRAIN, N_TEST, SECOND)
    assert contents(folder) == contents(small)


@contextmanager
def held_by_another() -> Iterator[bool]:
    yield False


def test_another_data_set_begun_a_moment_ago_is_refused(
    folder: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begin_another(*_: object) -> None:
        folder.cache.mkdir(parents=True, exist_ok=True)
        sealing.begin(folder, small_spec.model_copy(update={"seed": 7}))

    monkeypatch.setattr("phd_exp.rendering.render.require_bpy", begin_another)
    with pytest.raises(DatasetError, match="seed=7, but seed=0 is asked for"):
        render_shard(folder, small_spec, N_TRAIN, N_TEST, FIRST)
    assert not any(folder.images(split) for split in SPLITS)


def test_shared_locks_go_together_and_exclude_the_other_kind(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    lock = tmp_path / "lock"
    one, two = held(lock, shared=True, waiting="one"), held(lock, shared=True, waiting="two")
    with one, two, held_if_free(lock) as free:
        assert not free
    with held(lock, waiting="three"), held_if_free(lock) as free:
        assert not free
    with held_if_free(lock) as free:
        assert free
    assert capfd.readouterr().err == ""
