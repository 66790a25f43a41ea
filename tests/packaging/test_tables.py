"""`make tables`, as it is written in the Makefile, at the smallest size."""

import csv
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
RUNS = 14


def commands(environment: Path, *variables: str) -> list[list[str]]:
    """What make would run once everything is installed, in this folder."""
    (environment / ".installed").touch()
    done = subprocess.run(
        ["make", "--dry-run", "--no-print-directory", "tables", f"VENV={environment}", *variables],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    words = [shlex.split(line) for line in done.stdout.splitlines()]
    assert all(command[0] == f"{environment}/bin/python" for command in words)
    return [[sys.executable, *command[1:]] for command in words]


def test_it_asks_for_the_authors_protocol_on_a_gpu_unless_told_otherwise(tmp_path: Path) -> None:
    render, train, _ = commands(tmp_path)
    assert {"preset=paper", "recipe=strong"} < set(render) & set(train)
    assert {"experiment=table1,table2", "hydra/launcher=joblib"} < set(train)


@pytest.mark.slow
def test_both_tables_are_made_and_made_only_once(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="needs `pip install 'phd_exp[launchers]'`")
    render, train, report = commands(tmp_path, "PRESET=smoke", "RECIPE=strong", "JOBS=2", "MORE=logger=none")

    def said(command: list[str]) -> str:
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    said(render)
    assert f"{RUNS} jobs, 0 of them finished already" in said(train)
    said(report)
    rows = csv.DictReader((tmp_path / "report" / "tables" / "runs.csv").read_text().splitlines())
    assert len({(row["data"], row["model"], row["seed"]) for row in rows}) == RUNS
    assert f"{RUNS} jobs, {RUNS} of them finished already" in said(train)
