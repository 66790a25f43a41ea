"""The snippets of the pages run: Python blocks in order, page by page; commands up to their checked configuration.

A block whose first line names a file is that file.
"""

import itertools
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser

from phd_exp.cli import conf_folder
from phd_exp.cli.help import EXAMPLES, OF_VERB, VERBS
from phd_exp.cli.jobs import composed
from phd_exp.cli.train import checked_start
from phd_exp.config import check_render
from tests.docs.pages import PAGES, ROOT, blocks, commands, name
from tests.support.meshes import solid, write_mesh
from tests.support.synthetic import write_run

WIDTH = 86  # characters of code that a page shows at 1280 px
TRAINS = "guides/own_parts.md"
README, HELP = ROOT / "README.md", ROOT / "phd_exp" / "cli" / "help.py"
COMMANDS = {tuple(words): page for page in (*PAGES, README) for words in commands(page)}
COMMANDS |= {tuple(line.partition(" >")[0].split()[3:]): HELP for lines in EXAMPLES.values() for line in lines}


def of_a_page(page: Path) -> object:
    """A page that trains networks is slow."""
    return pytest.param(page, id=name(page), marks=[pytest.mark.slow] if name(page) == TRAINS else [])


@pytest.mark.parametrize("page", [of_a_page(page) for page in PAGES if blocks(page)])
def test_python_blocks_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _write_files(page, tmp_path, monkeypatch)
    scope: dict[str, object] = {}
    for block in blocks(page):
        assert block.language in ("python", "sh", "yaml"), f"{name(page)}:{block.line}: not run by anything"
        if block.language == "python" and block.file is None:
            # the line numbers of a traceback are those of the page
            exec(compile("\n" * (block.line - 1) + block.text, str(page), "exec"), scope)


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_commands_are_valid(
    words: tuple[str, ...], phd_exp: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    verb = next((word for word in words[:2] if word in VERBS), "train")
    _write_files(COMMANDS[words], tmp_path, monkeypatch)
    if any(word.startswith("--") for word in words):
        assert phd_exp(*words, *([] if "--cfg" in words else ["--cfg", "job"])).status == 0
    elif verb in OF_VERB:
        for single in _single_runs([word for word in words if word not in (verb, "-m")]):
            _check(verb, single)
    else:
        assert all("=" in word or word.endswith(".yaml") for word in words[1:])


@pytest.mark.parametrize("page", [page for page in (*PAGES, README) if commands(page)], ids=str)
def test_commands_name_their_preset_and_quote_lists(page: Path) -> None:
    """The default preset takes many hours without a GPU; some shells read brackets as a pattern of file names."""
    for line in re.findall(r"^(?:    )?(python -m phd_exp .*)$", page.read_text().replace("\\\n", " "), re.MULTILINE):
        command = line.partition(" #")[0]
        assert not re.search(r"\s[^\s'\"]*[\[{]", command), command
        words = command.split()[3:]
        verb = next((word for word in words[:2] if word in VERBS), "train")
        if verb in OF_VERB and not any(word.startswith(("--", "experiment=speed")) for word in words):
            assert any(word.startswith("preset=") for word in words), command


def _single_runs(words: list[str]) -> list[tuple[str, ...]]:
    """As few combinations of the values as contain each value; `tests/cli/test_sweep.py` expands experiments."""
    choices: list[list[str]] = []
    for word, item in zip(words, OverridesParser.create().parse_overrides(words), strict=True):
        several = list(item.sweep_string_iterator()) if item.is_sweep_override() else []
        if item.key_or_group in ("seed", "shard"):
            several = several[-1:]  # numbers that differ in nothing else
        if item.key_or_group == "experiment":
            for choice in several or [item.value()]:
                assert (conf_folder() / "experiment" / f"{choice}.yaml").is_file()
        else:
            choices.append([f"{item.get_key_element()}={value}" for value in several] or [word])
    n = max(map(len, choices), default=1)
    return list(zip(*(itertools.islice(itertools.cycle(values), n) for values in choices), strict=True)) or [()]


@cache  # many pages repeat a command
def _check(verb: str, overrides: tuple[str, ...]) -> None:
    config = composed(overrides, config_name="config" if verb == "train" else "render")
    if verb == "train":
        checked_start(config, list(overrides))
    else:
        check_render(config)


def test_commands_fit_a_page() -> None:
    for page in PAGES:
        lines = [line for line in page.read_text().splitlines() if re.match(r" *(python -m phd_exp|make|pip) ", line)]
        assert [line for line in lines if len(line) > WIDTH] == [], f"{name(page)}: continue with a backslash"


@cache
def _config_of_a_start() -> str:
    return yaml.safe_dump(composed(["preset=small", "recipe=strong", "backbone=imagenet"]))


def _write_files(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the files that a page shows, and go there."""
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    for mesh in ("part.glb", "cup.stl"):
        write_mesh(folder / mesh, solid("cube"))
    (folder / "camera.yaml").write_text("image_width: 640\nimage_height: 480\nfx: 900\nfy: 900\ncx: 320\ncy: 240\n")
    write_run(folder, n=4).path.rename("DIR")
    (folder / "DIR" / "config.yaml").write_text(_config_of_a_start())
    (folder / "rooms").mkdir()
    for number in range(4):
        (folder / f"rooms/{number}.jpg").touch()
    for block in blocks(page) if page.suffix == ".md" else ():
        if block.file is not None:
            (folder / block.file).parent.mkdir(parents=True, exist_ok=True)
            (folder / block.file).write_text(block.text)
