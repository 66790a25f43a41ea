"""Every file under conf/ composes into a configuration that passes the check."""

from collections.abc import Callable
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pytest
import yaml

from phd_exp.cli import choices_of, conf_folder
from phd_exp.cli.help import OF_VERB
from phd_exp.config import RunConfig, check, check_render
from phd_exp.records.choices import has_influence
from phd_exp.records.errors import ConfigError
from phd_exp.records.runs import SECTIONS
from phd_exp.records.spec import DatasetSpec
from tests.support.renders import RENDER

GROUPS = sorted({*OF_VERB["train"]} - {"loss"})  # which the model chooses
CHOICES = [[f"{group}={name}" for name in choices_of(group)] for group in GROUPS]
TOGETHER = [tuple(filter(None, words)) for words in zip_longest(*CHOICES)]


@pytest.fixture
def checked(composed: Callable[..., dict[str, Any]]) -> Callable[..., RunConfig]:
    return lambda *overrides: check(composed(*overrides))


@pytest.mark.parametrize("words", TOGETHER, ids=" ".join)
def test_every_choice_of_every_group_is_a_valid_configuration(
    checked: Callable, words: tuple[str, ...], tmp_path: Path
) -> None:
    """The first of all groups, the second of all, and so on."""
    (tmp_path / "part.obj").touch()
    own = {
        "data=folder": ["data.folder=photos", "data.n_held_out=1"],
        "data=object": [f"data.mesh={tmp_path}/part.obj"],
    }
    checked(*words, *(word for choice in words for word in own.get(choice, [])))


def test_every_file_begins_with_a_comment() -> None:
    for file in conf_folder().rglob("*.yaml"):
        lines = [line for line in file.read_text().splitlines() if line != "# @package _global_"]
        assert lines[0].startswith("# "), file


def test_the_command_line_overrides_all_files(checked: Callable) -> None:
    config = checked("preset=smoke", "backbone=resnet50", "model=mae_vz", "camera=constant", "data.n_train=48")
    assert config.backbone["depth"] == 50
    assert config.camera.focal_length == "constant"
    assert config.data.n_train == 48
    assert config.preset == "smoke"
    strong = checked("recipe=strong", "preset=small", "data.image_size=48", "model=mae_logz", "camera=known")
    assert (strong.data.image_size, strong.camera.focal_length) == (48, "known")


def test_pretrained_weights_come_with_smaller_steps(checked: Callable) -> None:
    strong = checked("recipe=strong").optimizer
    assert checked("recipe=strong", "optimizer=muon", "backbone=imagenet").optimizer == strong
    gentle = checked("recipe=strong", "backbone=imagenet").optimizer
    changed = {key for key in strong | gentle if strong[key] != gentle[key]}
    assert changed == {"lr", "orthogonal_lr"}
    assert all(gentle[key] <= strong[key] / 2 for key in changed)


@pytest.mark.parametrize("variant", ["occl", "scale", "occl_scale", "multiview"])
def test_variants_differ_only_in_the_keys_of_their_files(checked: Callable, variant: str) -> None:
    file = yaml.safe_load((conf_folder() / "data" / f"{variant}.yaml").read_text())
    base, keys = checked(f"data={file['defaults'][0]}").data.spec, file.keys() - {"defaults"}
    assert differing(base, checked(f"data={variant}").data.spec) == keys >= {"variant"}


def test_sequences_are_of_the_runs_own_scenes_and_others_are_held_out(checked: Callable) -> None:
    config = checked("data=occl", "evaluation.sequences=[[5,20],[2,200]]", "data.seed=3", "data.z_range=[4,5]")
    single = config.data.spec
    for n, frames, held_out in [(5, 20, 3), (2, 200, 1)]:
        found = [config.sequences[frames, False], config.sequences[frames, True]]
        tested, choosing = (one.spec for one in found)
        assert (tested.variant, choosing.variant) == (f"occl-sequences-{frames}", f"occl-sequences-{frames}-held-out")
        assert differing(single, tested) == {"variant", "frames"}
        assert differing(tested, choosing) == {"variant", "seed"}
        assert [one.n_test for one in found] == [n * frames, held_out * frames]
    both = checked("data=occl", "evaluation.sequences=[[5,20]]", "evaluation.sequence_cameras=2").sequences
    for held_out, name, n in (
        (False, "occl-sequences-20-cameras-2", 200),
        (True, "occl-sequences-20-held-out-cameras-2", 120),
    ):
        one = both[20, held_out]
        assert (one.name, one.n_test, one.spec.views, one.spec.view_angle_range) == (name, n, 2, (20, 60))
    assert checked("data=occl").sequences == {}
    assert not has_influence("evaluation.sequences")
    assert not has_influence("evaluation.sequence_cameras")
    # the file of sequences states the defaults of their motion
    assert differing(checked("data=scale").data.spec, checked("data=sequence").data.spec) == {"variant", "frames"}


def differing(one: DatasetSpec, other: DatasetSpec) -> set[str]:
    return {key for key in DatasetSpec.model_fields if getattr(one, key) != getattr(other, key)}


def test_several_views_of_scale_are_the_data_set_multiview(checked: Callable) -> None:
    config = checked("data=scale", "evaluation.multiview.scenes=9", "data.sensor_size=256", "data.seed=3")
    assert config.several_views.spec == checked("data=multiview", "data.sensor_size=256", "data.seed=3").data.spec
    own = checked("evaluation.multiview.scenes=9", "evaluation.multiview.views=2").several_views.spec
    assert (own.variant, own.scale_range, own.views) == ("default-multiview", (1.0, 1.0), 2)


@pytest.mark.parametrize("data", ["default", "occl", "scale", "occl_scale"])
def test_shifts_to_the_variants_are_these_data_sets(checked: Callable, data: str) -> None:
    config = checked(f"data={data}", "shift=[variants,scenes,images]", "evaluation.n_shifted=9", "data.seed=3")
    for variant in ("default", "occl", "scale", "occl_scale"):
        other = config.data_of(variant)
        assert other.spec == checked(f"data={variant}", "data.seed=3").data.spec
        assert (other.folder.name, other.n_test) == (variant, 9)
    for name, shift in yaml.safe_load((conf_folder() / "shift" / "scenes.yaml").read_text()).items():
        own, other = config.data.spec, config.data_of(name).spec
        assert differing(own, other) == {"variant", *shift["data"]}
        assert other.variant == f"{data}-{name}"
    assert config.data_of("dark").spec == config.data.spec


def test_focal_lengths_that_follow_from_a_camera_are_not_shifted(checked: Callable, tmp_path: Path) -> None:
    (tmp_path / "part.obj").touch()
    camera = ("data.f=900", "data.width=640", "data.height=480", "data.z_range=[2,3]")
    config = checked("data=object", f"data.mesh={tmp_path}/part.obj", *camera, "shift=scenes")
    with pytest.raises(ConfigError, match=r"shifts\.short_f\.data: f_range follows from data\.camera; expected .*"):
        config.data_of("short_f")
    assert config.data_of("far").spec.z_range == (5.0, 7.0)


@pytest.mark.parametrize(("words", "n"), [((0, 0), 1), ((0.5, 0), 2), ((0, 0.5), 2)])
def test_what_is_behind_objects_is_rendered_for_other_backdrops_and_prints(
    composed: Callable[..., dict[str, Any]], tmp_path: Path, words: tuple[float, float], n: int
) -> None:
    (tmp_path / "part.obj").touch()
    keys = (f"recipe.augmentation.{key}={share}" for key, share in zip(("backdrops", "prints"), words, strict=True))
    config = composed("data=object", f"data.mesh={tmp_path}/part.obj", *keys)
    rendered = check(config).rendered
    assert [data.spec.empty for data in rendered] == [False, True][:n]
    assert check_render(config | RENDER).rendered == rendered


def test_older_records_without_several_views_are_valid(composed: Callable[..., dict[str, Any]]) -> None:
    config = composed()
    for key in ("multiview", "sequences", "shifts", "n_shifted"):
        del config["evaluation"][key]
    for key in ("saturation_range", "half_hidden"):
        del config["data"][key]
    assert check(config).evaluation.multiview is None
    assert check(config) == check(composed()).model_copy(update={"evaluation": check(config).evaluation})


def test_every_configuration_has_the_sections_that_a_report_expects() -> None:
    required = {name for name, one in RunConfig.model_fields.items() if one.is_required()}
    assert set(SECTIONS) == required - {"seed", "runs", "preset", "logger"}  # numbers and names; a logger may be none
