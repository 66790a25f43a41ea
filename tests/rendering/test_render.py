"""A folder ends with the same bytes whatever the workers, the order, the shares and the interruptions."""

import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest

from phd_exp.records.dataset import SPLITS, DatasetFolder, sha256
from phd_exp.records.errors import DatasetError, RenderError
from phd_exp.records.files import read_jsonl
from phd_exp.records.spec import DatasetSpec, Shard
from phd_exp.rendering import blender, render, sealing
from phd_exp.rendering.render import ensure_rendered, render_all, worker_count
from phd_exp.rendering.sealing import Sample, begin, seal, side_file, side_files, unmade
from tests.support.renders import N_TEST, N_TRAIN, ROOT, contents, made, rendering_elsewhere, unsealed, wait_until

ALL = (N_TRAIN, N_TEST)
FIRST, SECOND = Shard(0, 2), Shard(1, 2)


@pytest.fixture
def begun(folder: DatasetFolder, small_spec: DatasetSpec) -> DatasetFolder:
    """A folder with a manifest and no samples."""
    folder.cache.mkdir(parents=True)
    begin(folder, small_spec)
    return folder


def test_the_manifest_and_the_records_fit_the_files(small: DatasetFolder, small_spec: DatasetSpec) -> None:
    assert small.manifest.spec == small_spec
    for split, n in zip(SPLITS, ALL, strict=True):
        assert small.manifest.splits[split].n == n
        assert small.manifest.splits[split].metadata_sha256 == sha256(small.metadata_path(split).read_bytes())
        for record in small.records(split):
            assert record.sha256 == sha256(small.image_path(split, record.index).read_bytes())
        assert not side_files(small, split)
    assert len({record.sha256 for split in SPLITS for record in small.records(split)}) == sum(ALL)


def test_a_sample_is_the_same_alone_and_in_another_order(
    begun: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    order: list[Sample] = [("train", 7), ("test", 2), ("train", 3), ("train", 0)]
    made = list(render_all(begun, small_spec, order, workers=2))
    assert sorted(made) == sorted((sample, True) for sample in order)
    for split, index in order:
        assert read_jsonl(side_file(begun, split, index)) == read_jsonl(small.metadata_path(split))[index : index + 1]


WAYS: dict[str, list[tuple[Shard | None, int, int]]] = {
    "more and more": [(None, 3, 1), (None, *ALL), (None, 2, 1)],
    "shares in another order": [(Shard(2, 3), *ALL), (Shard(0, 3), *ALL), (Shard(1, 3), *ALL)],
    "shares of other counts": [(SECOND, *ALL), (Shard(1, 4), *ALL), (FIRST, 6, 2), (None, *ALL)],
}


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_each_sample_is_rendered_once_in_any_way(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, copied: None,
    capfd: pytest.CaptureFixture[str], way: list[tuple[Shard | None, int, int]],
) -> None:  # fmt: skip
    """Nothing counts as finished before all that was asked for is there."""
    for shard, *wanted in way:
        is_whole = ensure_rendered(folder, small_spec, *wanted, shard=shard)
        assert is_whole == (not any(folder.missing(small_spec, *wanted).values()))
        assert is_whole or folder.manifest.count("train") == 0
    assert contents(folder) == contents(small)
    assert capfd.readouterr().err.count("copied") == sum(ALL)


def test_several_processes_share_an_empty_folder(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec
) -> None:
    with ExitStack() as stack:
        racing = [
            stack.enter_context(rendering_elsewhere(folder, small_spec, shard=shard, source=small))
            for shard in (None, None, FIRST, SECOND)
        ]
        said = [process.communicate()[1] for process in racing]
        assert [process.returncode for process in racing] == [0] * 4, said
    assert contents(folder) == contents(small)
    assert sum(text.count("copied") for text in said) == sum(ALL), "each image is rendered once"


def test_a_process_waits_for_the_images_of_others(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, copied: None,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    with rendering_elsewhere(folder, small_spec, source=small, seconds=0.5) as process:
        wait_until(lambda: made(folder))
        ensure_rendered(folder, small_spec, *ALL)
        assert contents(folder) == contents(small)
        process.communicate()
        assert process.returncode == 0
    assert "waiting for 1 images that other processes render" in capfd.readouterr().err
    assert contents(folder) == contents(small)


@pytest.mark.parametrize("survived", range(4))
def test_a_kill_while_sealing_loses_nothing(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, copied: None,
    monkeypatch: pytest.MonkeyPatch, survived: int,
) -> None:  # fmt: skip
    """At each of its writes in turn: two metadata files, the manifest, and the removal of side files."""
    ensure_rendered(folder, small_spec, *ALL)
    unsealed(folder)
    writes = iter(range(9))

    def dying(original: Callable[..., None]) -> Callable[..., None]:
        def write(*arguments: object) -> None:
            if next(writes) == survived:
                raise KeyboardInterrupt
            original(*arguments)

        return write

    with monkeypatch.context() as patched:
        patched.setattr(sealing, "write_atomic", dying(sealing.write_atomic))
        patched.setattr(DatasetFolder, "write_manifest", dying(DatasetFolder.write_manifest))
        patched.setattr(Path, "unlink", dying(Path.unlink))
        with pytest.raises(KeyboardInterrupt):
            seal(folder, small_spec, *ALL)
    assert unmade(folder, small_spec, *ALL) == []
    monkeypatch.setattr(render, "render_all", None)
    assert ensure_rendered(folder, small_spec, *ALL)
    assert contents(folder) == contents(small)


def test_a_lost_image_and_a_broken_record_are_rendered_again(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, copied: None
) -> None:
    ensure_rendered(folder, small_spec, *ALL)
    folder.image_path("train", 2).unlink()
    ensure_rendered(folder, small_spec, *ALL)
    assert contents(folder) == contents(small)
    unsealed(folder)
    side_file(folder, "train", 1).write_text("{}\n")
    with pytest.raises(DatasetError, match=r"000001\.json, line 1: .*; delete the file, and its image is rendered"):
        ensure_rendered(folder, small_spec, *ALL)
    side_file(folder, "train", 1).unlink()
    (folder.split_folder("train") / "metadata.partial.jsonl").touch()  # of an earlier version
    ensure_rendered(folder, small_spec, *ALL)
    assert contents(folder) == contents(small)


def test_a_script_without_a_guard_renders(folder: DatasetFolder, small_spec: DatasetSpec, tmp_path: Path) -> None:
    """Processes of the pool do not run it again, and find Blender although it is loaded here too."""
    script = tmp_path / "script.py"
    script.write_text(
        "from phd_exp.records.dataset import DatasetFolder\n"
        "from phd_exp.records.spec import DatasetSpec\n"
        "from phd_exp.rendering.blender import load_bpy\n"
        "from phd_exp.rendering.render import ensure_rendered\n"
        "load_bpy()\n"
        f"spec = DatasetSpec.model_validate_json({small_spec.model_dump_json()!r})\n"
        f"print(ensure_rendered(DatasetFolder({str(folder.root)!r}), spec, 1, 0))\n"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stdout) == (0, "True\n"), done.stderr


def test_nothing_is_loaded_when_nothing_is_missing(
    small: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rendered folder is of use on machines without Blender."""
    monkeypatch.setattr(blender.importlib.util, "find_spec", lambda _: None)
    ensure_rendered(small, small_spec, *ALL)


def test_a_missing_bpy_or_a_library_of_it_is_one_line(
    folder: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: str) -> None:
        raise ImportError("libXi.so.6: cannot open shared object file")

    monkeypatch.setattr(blender.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(RenderError, match=r"^bpy.* not installed: pip install 'phd_exp\[render\]'[^\n]*$|^rendering"):
        ensure_rendered(folder, small_spec, 1, 1)
    assert not folder.root.exists()
    monkeypatch.setattr(blender.importlib.util, "find_spec", lambda _: object())
    monkeypatch.setattr(blender.importlib, "import_module", broken)
    with pytest.raises(RenderError, match=r"libXi\.so\.6.*apt-get install .*libxi6"):
        blender.load_bpy()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"generator": 0}, "begun with generator 0, this is .*; move the folder"),
        ({"renderer": "bpy 4.2.0"}, "begun with renderer bpy 4.2.0, this is .*; move the folder"),
        ({"seed": 7}, "seed=7, but seed=0 is asked for"),
    ],
)
def test_another_data_set_or_make_is_not_continued(
    folder: DatasetFolder, small: DatasetFolder, small_spec: DatasetSpec, monkeypatch: pytest.MonkeyPatch,
    change: dict[str, object], message: str,
) -> None:  # fmt: skip
    """Also if another process begins it at the last moment."""
    of_spec = {"spec": small_spec.model_copy(update=change)} if "seed" in change else change

    def begin_another() -> None:
        folder.root.mkdir()
        folder.write_manifest(small.manifest.model_copy(update={"splits": {}} | of_spec))

    monkeypatch.setattr(render, "require_bpy", begin_another)
    with pytest.raises(DatasetError, match=message):
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
    assert sorted(path.name for path in folder.split_folder("train").iterdir()) == ["000000.png", "000001.png"]


def test_few_samples_take_few_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "usable_cores", lambda: 16)
    assert [worker_count(tasks) for tasks in (1, 8, 9, 64, 10_000)] == [1, 1, 2, 8, 16]
    assert [worker_count(tasks, cores=4) for tasks in (1, 9, 10_000)] == [1, 2, 4]
