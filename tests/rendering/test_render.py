"""A folder ends with the same bytes whatever the workers, the order, and the interruptions."""

import os
from pathlib import Path

import pytest

from phd_exp.records.dataset import DatasetFolder, sha256
from phd_exp.records.errors import DatasetError, RenderError
from phd_exp.records.processes import Child
from phd_exp.records.scenes import Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering import blender
from phd_exp.rendering.render import ONE_THREAD, ensure_rendered, render_all, worker_count
from tests.support.renders import contents


def test_the_manifest_and_the_records_fit_the_files(small: DatasetFolder, small_spec: DatasetSpec) -> None:
    assert small.manifest.spec == small_spec
    counts: dict[Split, int] = {"train": 12, "test": 4}
    for split, n in counts.items():
        assert small.manifest.splits[split].n == n
        assert small.manifest.splits[split].metadata_sha256 == sha256(small.metadata_path(split).read_bytes())
        records = small.records(split)
        assert len(records) == n
        for record in records:
            assert record.sha256 == sha256(small.image_path(split, record.index).read_bytes())
    assert len({record.sha256 for split in counts for record in small.records(split)}) == 16


def test_a_sample_is_the_same_alone_and_in_another_order(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    folder.root.mkdir()
    for path in (folder.cache, folder.split_folder("train"), folder.split_folder("test")):
        path.mkdir()
    order: list[tuple[Split, int]] = [("train", 7), ("test", 2), ("train", 3), ("train", 0)]
    for record in render_all(folder, small_spec, order, workers=1):
        assert record == small.records(record.split)[record.index]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system binds no process to cores")
def test_a_worker_has_as_many_threads_on_many_cores_as_on_one(folder: DatasetFolder, small_spec: DatasetSpec) -> None:
    folder.split_folder("train").mkdir(parents=True)
    cores, threads = os.sched_getaffinity(0), []
    for some in (cores, {min(cores)}):
        os.sched_setaffinity(0, some)  # a worker inherits it
        try:
            with Child("phd_exp.rendering.worker", ONE_THREAD) as worker:
                worker.send((folder, small_spec))
                for index in range(2):
                    worker.send(("train", index))
                    worker.receive()
                threads.append(len(os.listdir(f"/proc/{worker.process.pid}/task")))
        finally:
            os.sched_setaffinity(0, cores)
    assert threads[0] == threads[1]


def test_a_folder_grows_and_keeps_what_it_has(
    folder: DatasetFolder,
    small: DatasetFolder,
    small_spec: DatasetSpec,
    copied: None,
    capfd: pytest.CaptureFixture[str],
) -> None:
    ensure_rendered(folder, small_spec, n_train=3, n_test=1)
    assert folder.manifest.splits["train"].n == 3
    first = folder.image_path("train", 0).stat().st_mtime_ns
    assert "rendering 4 images" in capfd.readouterr().err
    ensure_rendered(folder, small_spec, n_train=12, n_test=4)
    assert "rendering the remaining 12 images" in capfd.readouterr().err
    assert folder.image_path("train", 0).stat().st_mtime_ns == first
    ensure_rendered(folder, small_spec, n_train=2, n_test=1)
    assert contents(folder) == contents(small), "asking for less takes nothing away"
    assert capfd.readouterr() == ("", "")


def test_nothing_is_loaded_when_nothing_is_missing(
    small: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rendered folder is of use on machines without Blender."""
    monkeypatch.setattr(blender.importlib.util, "find_spec", lambda _: None)
    ensure_rendered(small, small_spec, n_train=12, n_test=4)


def test_a_missing_bpy_is_one_line(
    folder: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blender.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(RenderError, match=r"bpy.* not installed: pip install 'phd_exp\[render\]'") as error:
        ensure_rendered(folder, small_spec, 1, 1)
    assert "\n" not in str(error.value)
    assert not folder.root.exists()


def test_a_missing_library_of_bpy_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_: str) -> None:
        raise ImportError("libXi.so.6: cannot open shared object file")

    monkeypatch.setattr(blender.importlib.util, "find_spec", lambda _: object())
    monkeypatch.setattr(blender.importlib, "import_module", broken)
    with pytest.raises(RenderError, match=r"libXi\.so\.6.*apt-get install .*libxi6"):
        blender.load_bpy()


@pytest.mark.parametrize(("key", "value"), [("generator", 0), ("renderer", "bpy 4.2.0")])
def test_a_folder_of_another_make_is_not_continued(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, key: str, value: object
) -> None:
    folder.root.mkdir()
    folder.write_manifest(small.manifest.model_copy(update={key: value, "splits": {}}))
    with pytest.raises(DatasetError, match=f"begun with {key} {value}, this is .*; move the folder"):
        ensure_rendered(folder, small_spec, n_train=1, n_test=0)


def test_an_image_that_cannot_be_written_is_one_line(
    folder: DatasetFolder, small_spec: DatasetSpec, tmp_path: Path
) -> None:
    """Nor a folder: a path below a file is refused even to root."""
    (tmp_path / "file").touch()
    with pytest.raises(RenderError, match=r"cannot be written .* choose another data\.root") as error:
        ensure_rendered(DatasetFolder(tmp_path / "file" / "default"), small_spec, 1, 1)
    assert "\n" not in str(error.value)
    (folder.image_path("train", 1) / "in the way").mkdir(parents=True)
    with pytest.raises(RenderError, match=r"000001\.png.*: cannot be written") as error:
        ensure_rendered(folder, small_spec, n_train=2, n_test=0, workers=1)
    assert "\n" not in str(error.value)
    assert sorted(path.name for path in folder.split_folder("train").iterdir()) == [
        "000000.png",
        "000001.png",
        "metadata.partial.jsonl",
    ]


def test_few_samples_take_few_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("phd_exp.rendering.render.usable_cores", lambda: 16)
    assert [worker_count(tasks) for tasks in (1, 8, 9, 64, 10_000)] == [1, 1, 2, 8, 16]
    assert [worker_count(tasks, cores=4) for tasks in (1, 9, 10_000)] == [1, 2, 4]
