"""A run's name contains every override that can change a number, and no other; a run first prints its work."""

from collections.abc import Callable
from pathlib import Path

import pytest

import phd_exp as package
from phd_exp.cli.train import announce, run_name
from phd_exp.config import RunConfig, check
from phd_exp.records.errors import ConfigError
from phd_exp.records.runs import RunFolder


@pytest.fixture(scope="module")
def config(composed) -> RunConfig:  # type: ignore[no-untyped-def]
    return check(composed("preset=smoke"))


def test_the_name_contains_the_overrides_that_can_change_a_number(config: RunConfig) -> None:
    for override in (
        *("runs=elsewhere", "logger=none", "logger.project=mine", "data.name=mine", "data.root=/data"),
        *("data.workers=1", "trainer.progress_bar=false", "trainer.threads=1"),
    ):
        assert run_name(config, [override]).overrides == ()
    for override in (
        *("data.n_train=8", "data.folder=photos", "backbone=resnet50", "camera=constant", "optimizer.lr=0.1"),
        *("recipe.localisation=0", "trainer.precision=float32"),
    ):
        assert run_name(config, [override]).overrides == (override,)
        assert run_name(config, [f"+{override}"]).overrides == (override,)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("optimizer.lr=1e-3", "optimizer.lr=0.001"),
        ("data.occluders=true", "data.occluders=True"),
        ("data.f_range=[1, 2]", "data.f_range=[1,2]"),
        ("+optimizer.eps=1e-7", "++optimizer.eps=1e-7"),
    ],
)
def test_one_value_has_one_name(config: RunConfig, one: str, other: str) -> None:
    """A sweep rewrites the values of its runs."""
    assert run_name(config, [one]) == run_name(config, [other])


def test_an_equal_run_is_named_before_the_training(
    composed: Callable, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    base = ["preset=smoke", f"data.root={tmp_path}", f"runs={tmp_path}"]
    default = check(composed(*base))
    first = RunFolder(run_name(default, base).folder(tmp_path))
    with first.held(), first.recording(None):
        first.write_config(default.model_dump(mode="json"))
    for word, is_equal in (("optimizer.lr=0.001", True), ("trainer.threads=1", True), ("optimizer.lr=0.002", False)):
        checked = check(composed(*base, word))
        announce(checked, RunFolder(run_name(checked, [*base, word, "data.n_held_out=8"]).folder(tmp_path)), base)
        assert (f"{first.path} is finished, with an equal configuration" in capsys.readouterr().out) == is_equal
    (first.path / "config.yaml").write_text("[")
    announce(default, RunFolder(first.path.with_name("seed0-0")), base)
    assert "an equal configuration" not in capsys.readouterr().out


COSTLY = ["model=mae_logz", "data=scale"]
COST = "11000 images to render, then 50 epochs of resnet50 on 8000 images of 224 px"
CHEAP = "4200 images to render, then 30 epochs of resnet10 on 3200 images of 64 px, on the CPU"


@pytest.mark.parametrize(
    ("gpu", "words", "said", "lines"),
    [(True, COSTLY, COST, 1), (False, COSTLY, COST, 3), (False, ["preset=small"], CHEAP, 1)],
)
def test_a_run_first_prints_its_cost(
    composed, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path,
    gpu: bool, words: list[str], said: str, lines: int,
) -> None:  # type: ignore[no-untyped-def]  # fmt: skip
    monkeypatch.setattr("phd_exp.hardware.has_gpu", lambda accelerator: gpu)
    announce(check(composed(*words, f"data.root={tmp_path}")), RunFolder(Path("runs/x")), words)
    first, *rest = capsys.readouterr().out.splitlines()
    assert first.startswith(f"runs/x: {said}")
    assert len(rest) == lines - 1
    if rest:
        assert rest[-1].endswith("python -m phd_exp model=mae_logz data=scale preset=small")


def test_one_word_instead_of_a_list_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"^overrides: got 'preset=smoke'; expected a list .*\['preset=smoke'\]$"):
        package.train("preset=smoke")
