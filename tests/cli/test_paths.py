"""Any path is one value of a key, in every verb; what Hydra reads already stays as it is."""

from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from pydantic import BaseModel

from phd_exp.cli.paths import PATHS, quoted
from phd_exp.config import RenderConfig, RunConfig
from phd_exp.config.sections import FolderConfig, RenderedConfig
from phd_exp.records.spec import DatasetSpec

NAMES = [
    "box(1).obj", "boîte.obj", "José/部品.glb", "a=b.obj", "a,b.obj", "#1.obj", "[new].obj", "[new]", "{x}.obj",
    "~old.obj", "it's.obj", "'a'b.obj", 'say "x".obj', "end\\", "a:b/c d.obj", "50%.obj", "choice(a).obj", "&;!.obj",
]  # fmt: skip


def values(word: str) -> object:
    return OverridesParser.create().parse_override(word).value()


@pytest.mark.parametrize("name", NAMES)
def test_a_path_is_one_value(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path(name).parent.mkdir(exist_ok=True)
    Path(name).touch()
    for several in (False, True):
        (word,) = quoted([f"data.mesh={name}"], several)
        assert values(word) == name
        assert quoted([word], several) == [word]
    absent = tmp_path / "absent" / name
    assert values(quoted([f"+data.folder={absent}"])[0]) == str(absent)


@pytest.mark.parametrize(
    "word",
    [
        *("runs=runs", "data.root=/a/b c", "data.backdrops=null", "data.folder=2024", "data.mesh=box\\(1\\).obj"),
        *("data.mesh='box(1).obj'", "data.distractor_meshes=[a.obj,'b (1).obj']", "data.mesh=${oc.env:HOME}/a.obj"),
        *("data.f_range=[1,2]", "seed=0,1", "name=é"),
    ],
)
def test_what_hydra_reads_stays(word: str) -> None:
    assert quoted([word]) == [word]


def test_commas_separate_the_values_of_a_sweep_and_of_a_list() -> None:
    for word in ("data.mesh=a.obj,b.obj", "data.mesh=choice(a.obj,b.obj)", "data.mesh=glob(*)"):
        assert quoted([word], several=True) == [word]
    assert quoted(["data.mesh=é.obj,b.obj"], several=True) == ["data.mesh='é.obj',b.obj"]
    assert quoted(["data.distractor_meshes=[é.obj,b.obj]"]) == ["data.distractor_meshes=['é.obj',b.obj]"]


def test_the_home_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/José")
    assert quoted(["data.root=~/renders", "data.mesh=~old.obj"]) == [
        "data.root='/home/José/renders'",
        "data.mesh='~old.obj'",
    ]


def test_the_keys_are_those_of_the_configuration() -> None:
    def paths(model: type[BaseModel], prefix: str = "") -> set[str]:
        fields = model.model_fields.items()
        return {
            prefix + name
            for name, field in fields
            if any(kind in str(field.annotation) for kind in ("Path", "Asset", "Calibration"))
        }

    found = paths(RunConfig) | paths(RenderConfig)
    for section in (RenderedConfig, FolderConfig, DatasetSpec):
        found |= paths(section, "data.")
    assert found == set(PATHS)


@pytest.mark.parametrize("verb", [[], ["render"]])
def test_verbs_read_any_path(phd_exp: Callable, verb: list[str]) -> None:
    outcome = phd_exp(*verb, "--cfg", "job", "preset=smoke", "data.root=a,b=[é] (1)#")
    assert (outcome.status, outcome.err) == (0, "")
    assert "root: a,b=[é] (1)#" in outcome.out
