"""Files are whole or absent, and a journal survives the death of its writer."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from phd_exp.records.errors import CorruptFileError
from phd_exp.records.files import TEMPORARY, make_folder, read_jsonl, remove_temporaries, write_atomic


@given(content=st.text() | st.binary())
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, content: str | bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "written"
    write_atomic(path, content)
    assert path.read_bytes() == (content.encode() if isinstance(content, str) else content)
    path.unlink()


def test_a_failed_write_leaves_the_old_content_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "file"
    write_atomic(path, "old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_atomic(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.parametrize("content", ["old", None])
def test_what_a_link_leads_to_is_written_as_an_ordinary_file(tmp_path: Path, content: str | None) -> None:
    (tmp_path / "far").mkdir()
    if content:
        (tmp_path / "far" / "file").write_text(content)
    (tmp_path / "link").symlink_to("far/file")
    write_atomic(tmp_path / "link", "new")
    (tmp_path / "ordinary").write_text("")
    assert os.readlink(tmp_path / "link") == "far/file"
    assert (tmp_path / "link").stat().st_mode == (tmp_path / "ordinary").stat().st_mode
    assert [(file.name, file.read_text()) for file in (tmp_path / "far").iterdir()] == [("file", "new")]


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: os.symlink("there", path)])
def test_only_a_plain_file_is_replaced(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / "there")
    before = (tmp_path / "there").lstat()
    with pytest.raises(OSError, match="there"):
        write_atomic(tmp_path / "there", "new")
    assert (tmp_path / "there").lstat() == before
    assert os.listdir(tmp_path) == ["there"]


def test_leftovers_of_killed_writers_are_removed_and_nothing_else(tmp_path: Path) -> None:
    script = (
        "import os, signal; from phd_exp.records import files\n"
        "os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"files.write_atomic({str(tmp_path / 'file')!r}, 'new')"
    )
    subprocess.run([sys.executable, "-c", script], cwd=Path(__file__).parents[2], check=False)
    (leftover,) = tmp_path.iterdir()
    kept = [tmp_path / name for name in ("kept", ".of-another.tmp", f".notes.{'0' * 32}.tmp")]
    for path in kept:
        path.write_text("")
    (tmp_path / f".a.mcap.0{TEMPORARY}").mkdir()
    make_folder(tmp_path)
    assert not leftover.exists()
    assert sorted(tmp_path.iterdir()) == sorted(kept)


def test_what_is_being_written_is_no_leftover(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: remove_temporaries(tmp_path))
    write_atomic(tmp_path / "file", "new")
    assert (tmp_path / "file").read_text() == "new"


rows = st.lists(st.dictionaries(st.text(), st.integers() | st.text() | st.none(), max_size=3))


@given(rows=rows, torn=st.integers(0, 5))
def test_lines_come_back_without_a_torn_one(
    tmp_path_factory: pytest.TempPathFactory, rows: list[Any], torn: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "lines"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows) + '{"a":'[:torn])
    assert read_jsonl(path) == rows
    assert read_jsonl(path, limit=2) == rows[:2]


@pytest.mark.parametrize("line", ["nonsense", '{"a": ', "\ufffd", ""])
def test_a_bad_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "lines"
    path.write_text(f'{{"a": 1}}\n{line}\n{{"a": 3}}\n')
    with pytest.raises(CorruptFileError, match=r"lines, line 2: not a valid record") as error:
        read_jsonl(path)
    assert "\n" not in str(error.value)


def test_a_sealed_file_has_no_torn_line(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    path.write_text('{"a": 1}\n{"a"')
    with pytest.raises(CorruptFileError, match="line 2"):
        read_jsonl(path, sealed=True)
    assert read_jsonl(path, limit=1, sealed=True) == [{"a": 1}], "only the wanted lines are parsed"
