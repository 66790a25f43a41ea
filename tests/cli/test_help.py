"""`--help` is quick, complete, and imports nothing heavy."""

import os
import subprocess
import sys
import time
from collections.abc import Callable

import pytest

from phd_exp import __version__ as phd_exp_version
from phd_exp.cli import choices_of, conf_folder, short_choices
from phd_exp.cli.help import COMPLETION, EXAMPLES, OF_VERB, VERBS, keys_of


def test_help_within_a_second_and_without_torch() -> None:
    watch = (
        "import sys, runpy; sys.argv = ['phd_exp', '--help']\n"
        "try: runpy.run_module('phd_exp', run_name='__main__')\n"
        "except SystemExit as stop: assert stop.code == 0\n"
        "assert not {'torch', 'hydra', 'lightning', 'numpy'} & set(sys.modules)"
    )
    start = time.monotonic()
    done = subprocess.run([sys.executable, "-c", watch], capture_output=True, text=True, env={**os.environ})
    assert done.returncode == 0, done.stderr
    assert time.monotonic() - start < 1


def test_help_lists_verbs_groups_and_choices_with_examples(phd_exp: Callable) -> None:
    outcome = phd_exp("--help")
    assert outcome.status == 0
    groups = {path.name for path in conf_folder().iterdir() if path.is_dir()} | {
        group for group, *_ in short_choices()
    }
    assert set(OF_VERB["train"]) == groups - {"hydra"}  # which selects the launcher and the sweeper
    choices = [choice for group in OF_VERB["train"] for choice in choices_of(group)]
    assert all(word in outcome.out for word in [*VERBS, *OF_VERB["train"], *choices, COMPLETION])
    assert VERBS.keys() == EXAMPLES.keys() >= OF_VERB.keys()
    for verb in VERBS:
        outcome = phd_exp(verb, "--help")
        assert outcome.status == 0
        assert all(example in outcome.out for example in EXAMPLES[verb])


@pytest.mark.parametrize("verb", OF_VERB)
def test_help_lists_every_key_once_for_each_choice(verb: str) -> None:
    found = {heading: {name: default for name, _, default, _ in keys} for heading, keys in keys_of(verb).items()}
    assert sum(map(len, found.values())) == sum(map(len, keys_of(verb).values()))
    assert all("???" not in default for keys in found.values() for default in keys.values())
    (rendered,) = (keys for heading, keys in found.items() if heading.startswith("data: "))
    assert {"data.variant", "data.root", "data.f_range"} <= rendered.keys()
    assert rendered["data.n_train"] == "set by preset"
    if verb == "train":
        assert (found[""]["seed"], found[""]["evaluation.shifts"]) == ("0", "empty")
        assert found["trainer"]["trainer.max_epochs"] == "set by preset"
        assert found["data=folder"]["data.folder"] == "required"
        assert [found[f"optimizer={name}"]["optimizer.lr"] for name in ("adam", "muon")] == ["0.001", "0.002"]
        kinds = {name: kind for keys in keys_of(verb).values() for name, kind, *_ in keys}
        assert [kinds[key] for key in ("seed", "data.f_range", "optimizer.fused")] == ["int", "list", "bool"]
        assert kinds["trainer.accelerator"] == "auto|cpu|gpu"


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("phd-exp model=mae_v", "model=mae_vz"),
        ("phd-exp -m seed=0,1 experiment=table", "experiment=table1 experiment=table2"),
        ("phd-exp render data=occl_", "data=occl_scale"),
        ("phd-exp -m render shar", "shard="),
        ("phd-exp predict ru", ""),
    ],
)
def test_a_shell_completes_groups_choices_and_keys(
    phd_exp: Callable, monkeypatch: pytest.MonkeyPatch, line: str, offered: str
) -> None:
    assert "complete -o nospace" in phd_exp("-sc", "install=bash").out
    monkeypatch.setenv("COMP_LINE", line)
    outcome = phd_exp("-sc", "query=bash")
    assert (outcome.status, outcome.out.strip(), outcome.err) == (0, offered, "")


@pytest.mark.parametrize("verb", [[], ["render"]])
@pytest.mark.parametrize("place", range(3))
def test_hydra_options_may_stand_between_overrides(phd_exp: Callable, verb: list[str], place: int) -> None:
    words = ["data.n_test=7", "preset=smoke"]
    words[place:place] = ["--package", "data.n_test", "--cfg", "job"]
    assert phd_exp(*verb, *words).out.strip() == "7"
    assert phd_exp("--version").out == f"phd_exp {phd_exp_version}\n"


@pytest.mark.parametrize(
    ("redirection", "status", "said"),
    [
        ("| true", 141, ""),  # the status of a programme ended by SIGPIPE, as by `| head`
        ("> /dev/full", 1, "error: standard output: No space left on device\n"),
        (">&-", 0, ""),
    ],
)
def test_unwritable_output_gives_at_most_one_line(redirection: str, status: int, said: str) -> None:
    command = f"(sleep 0.2; {sys.executable} -m phd_exp --help) {redirection}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (status, said)
