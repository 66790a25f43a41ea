"""The Dockerfile installs what the README, the Makefile and the wheel name, and nothing else."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
STAGES = dict(re.findall(r"^FROM \S+ AS (\w+)\n(.*?)(?=^FROM |\Z)", DOCKERFILE, re.MULTILINE | re.DOTALL))
README = (ROOT / "README.md").read_text()
MAKEFILE = (ROOT / "Makefile").read_text()


def packages(text: str) -> set[str]:
    """The Debian packages of the only `apt-get install` in a text."""
    ((words),) = re.findall(r"apt-get install (.*)", text)
    return {word for word in words.partition("&&")[0].split() if not word.startswith("--")}


def test_the_x_libraries_are_those_of_the_readme() -> None:
    assert packages(STAGES["render"]) == packages(README) | {"make"}
    assert "apt-get" not in STAGES["predict"]


def test_python_is_the_one_of_the_makefile() -> None:
    ((version),) = set(re.findall(r"FROM python:([\d.]+)-slim", DOCKERFILE))
    assert f"command -v python{version}" in MAKEFILE


def test_commands_are_those_of_the_readme_and_the_makefile() -> None:
    commands = re.findall(r"^    (make \w+) ", README, re.MULTILINE)
    assert [f"RUN {command}" for command in commands if command != "make install"] == STAGES["check"].splitlines()
    assert "RUN make install\n" in STAGES["render"]
    assert "--constraint constraints.txt" in STAGES["predict"]
    assert "--constraint constraints.txt" in MAKEFILE


def test_a_prediction_has_all_files_of_the_wheel_and_the_pins() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    copied = [
        word for words in re.findall(r"^COPY (.*)", STAGES["predict"], re.MULTILINE) for word in words.split()[:-1]
    ]
    needed = {*wheel["packages"], *wheel["force-include"], project["project"]["readme"]}
    assert set(copied) == needed | {"pyproject.toml", "constraints.txt"}
