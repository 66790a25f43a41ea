"""An installed wheel is the whole programme: command, configuration, types; nothing of the checkout is needed."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from phd_exp.cli import conf_folder

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
COMPLETE = """
eval "$(phd-exp -sc install=bash)"
COMP_LINE="$*" COMP_POINT=${#COMP_LINE} COMP_CWORD=$(($# - 1)) COMP_WORDS=("$@")
hydra_bash_completion
echo "${COMPREPLY[@]}"
"""
"""What a shell does when TAB is pressed after the words it was given."""


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which a wheel of this checkout was installed, without what it depends on."""
    wheels, target = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("installed")
    offline = ["--no-deps", "--no-index", "--quiet", "--disable-pip-version-check"]
    pip = [sys.executable, "-m", "pip"]
    subprocess.run(
        [*pip, "wheel", str(ROOT), "--no-build-isolation", *offline, "--wheel-dir", str(wheels)], check=True
    )
    (wheel,) = wheels.glob("phd_exp-*.whl")
    subprocess.run([*pip, "install", str(wheel), *offline, "--target", str(target)], check=True)
    return target


@pytest.fixture
def run(installed: Path, tmp_path: Path) -> Callable[..., str]:
    """Run a command in an empty folder, with nothing but the wheel on the path; what it printed."""
    environment = os.environ | {
        "PYTHONPATH": str(installed),
        "PATH": f"{installed / 'bin'}{os.pathsep}{os.environ['PATH']}",
    }

    def command(*words: str) -> str:
        done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, env=environment)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return command


def test_what_runs_is_the_wheel(run: Callable[..., str], installed: Path) -> None:
    for words in (("phd-exp",), (sys.executable, "-m", "phd_exp")):
        assert str(installed / "phd_exp" / "conf") in run(*words, "--help")


def test_configuration_types_and_assets_are_in_it(run: Callable[..., str], installed: Path) -> None:
    assert "max_epochs: 50" in run("phd-exp", "--cfg", "job")
    assert "occluders: true" in run("phd-exp", "render", "data=occl", "--cfg", "job")
    files = {file.relative_to(conf_folder()) for file in conf_folder().rglob("*.yaml")}
    there = installed / "phd_exp" / "conf"
    assert {file.relative_to(there) for file in there.rglob("*.yaml")} == files
    assert (installed / "phd_exp" / "py.typed").is_file()
    assert list((installed / "phd_exp" / "reports" / "site" / "templates").glob("*.html"))
    assert not (installed / "tests").exists()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("model=mae_v",), "model=mae_vz"),
        (("render", "data=occl_"), "data=occl_scale"),
        (("-m", "experiment=table"), "experiment=table1 experiment=table2"),
        (("predict", "ru"), ""),
    ],
)
def test_a_shell_completes_its_words(run: Callable[..., str], words: tuple[str, ...], offered: str) -> None:
    assert run("bash", "-c", COMPLETE, "bash", "phd-exp", *words).strip() == offered
