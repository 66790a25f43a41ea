"""What the pages show is run: Python blocks in order, page by page; commands as far as their configuration.

A YAML block is the file that its first line names.
"""

from collections.abc import Callable
from pathlib import Path

import hydra
import pytest

from phd_exp.cli import conf_folder
from phd_exp.cli.help import OF_VERB, VERBS
from phd_exp.cli.sweep import plan
from phd_exp.training.config import check, check_render
from tests.docs.pages import PAGES, ROOT, blocks, commands, name

README = ROOT / "README.md"
COMMANDS = {tuple(words): page for page in (*PAGES, README) for words in commands(page)}
CHECKS = {"train": ("config", check), "render": ("render", check_render)}


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)], ids=name)
def test_python_blocks_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scope: dict[str, object] = {}
    for block in blocks(page):
        assert block.language in ("python", "sh", "yaml"), f"{name(page)}:{block.line}: not run by anything"
        if block.language == "python":
            # lines of their own, so that a traceback shows those of the page
            exec(compile("\n" * (block.line - 1) + block.text, str(page), "exec"), scope)


@pytest.mark.parametrize(
    ("words", "page"),
    [
        pytest.param(words, page, id=" ".join(words), marks=pytest.mark.slow if page == README else ())
        for words, page in COMMANDS.items()
    ],
)
def test_commands_are_those_of_this_programme(
    words: tuple[str, ...], page: Path, phd_exp: Callable, tmp_path: Path
) -> None:
    verb = next((word for word in words[:2] if word in VERBS), "train")
    if any(word.startswith("--") for word in words):
        _write_files(page, tmp_path)
        assert phd_exp(*words).status == 0
    elif verb in OF_VERB:
        config_name, checked = CHECKS[verb]
        overrides = [word for word in words if word not in (verb, "-m")]
        with hydra.initialize_config_dir(str(conf_folder()), version_base="1.3"):
            _, jobs = plan(overrides, config_name)
        assert jobs
        for job in jobs:
            checked(job.config)
    else:
        assert all("=" in word for word in words[1:])


def test_there_are_snippets_on_every_page_of_an_idea() -> None:
    for page in PAGES:
        if page.parent.name == "ideas":
            assert len([block for block in blocks(page) if block.language == "python"]) >= 2, name(page)
            assert commands(page), name(page)


def _write_files(page: Path, folder: Path) -> None:
    for block in blocks(page):
        if block.language == "yaml":
            file = folder / block.text.splitlines()[0].removeprefix("# ")
            file.parent.mkdir(parents=True)
            file.write_text(block.text)
