"""Any path is one value of a key, in every verb; what Hydra reads already stays as it is."""

from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import BaseModel

from phd_exp.cli.words import PATHS, overrides, parsed
from phd_exp.config import FolderConfig, RenderConfig, RenderedConfig, RunConfig
from phd_exp.records.spec import DatasetSpec

NAMES = [
    "box(1).obj", "boîte.obj", "José/部品.glb", "a=b.obj", "a,b.obj", "#1.obj", "[new].obj", "[new]", "{x}.obj",
    "~old.obj", "it's.obj", "'a'b.obj", 'say "x".obj', "end\\", "a:b/c d.obj", "50%.obj", "choice(a).obj", "&;!.obj",
]  # fmt: skip
READ = [
    *("runs=runs", "data.root=/a/b c", "data.backdrops=null", "data.folder=2024", "data.mesh=box\\(1\\).obj"),
    *("data.mesh='box(1).obj'", "data.distractor_meshes=[a.obj,'b (1).obj']", "data.mesh=${oc.env:HOME}/a.obj"),
    *("data.f_range=[1,2]", "seed=0,1", "data.mesh=choice(a.obj,b.obj)", "data.mesh=glob(*)"),
]


@pytest.mark.parametrize("name", NAMES)
def test_a_path_is_one_value(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).parent.mkdir(exist_ok=True)
    Path(name).touch()
    for several in (False, True):
        (word,) = overrides([f"data.mesh={name}"], several)
        assert parsed(word).value() == name
        assert overrides([word], several) == [word]
    absent = tmp_path / "absent" / name
    assert parsed(overrides([f"+data.folder={absent}"])[0]).value() == str(absent)


def test_what_hydra_reads_stays_and_other_values_of_a_list_or_sweep_are_quoted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("HOME", "/home/José")
    assert overrides(READ) == READ
    assert overrides([*READ, "data.mesh=a.obj,b.obj"], several=True) == [*READ, "data.mesh=a.obj,b.obj"]
    assert overrides(["data.mesh=é.obj,b.obj"], several=True) == ["data.mesh='é.obj',b.obj"]
    assert overrides(["data.distractor_meshes=[é.obj,b.obj]"]) == ["data.distractor_meshes=['é.obj',b.obj]"]
    assert overrides(["data.root=~/a", "data.mesh=~b"]) == ["data.root='/home/José/a'", "data.mesh='~b'"]


def test_the_keys_are_those_of_the_configuration() -> None:
    def paths(model: type[BaseModel], prefix: str = "") -> set[str]:
        fields = {name: str(field.annotation) for name, field in model.model_fields.items()}
        return {
            prefix + name
            for name, text in fields.items()
            if any(kind in text for kind in ("Path", "Asset", "Calibration"))
        }

    of_data = (paths(section, "data.") for section in (RenderedConfig, FolderConfig, DatasetSpec))
    assert paths(RunConfig).union(paths(RenderConfig), *of_data) == set(PATHS)


@pytest.mark.parametrize("verb", [[], ["render"]])
def test_verbs_read_any_path(phd_exp: Callable, verb: list[str]) -> None:
    outcome = phd_exp(*verb, "--cfg", "job", "preset=smoke", "data.root=a,b=[é] (1)#")
    assert (outcome.status, outcome.err) == (0, "")
    assert "root: a,b=[é] (1)#" in outcome.out
