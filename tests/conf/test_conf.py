"""Every file under conf/ composes into a configuration that passes the check."""

from collections.abc import Callable
from itertools import cycle, zip_longest
from pathlib import Path
from typing import Any

import pytest

from phd_exp.cli import conf_folder
from phd_exp.records.choices import flatten
from phd_exp.records.runs import SECTIONS
from phd_exp.records.spec import DatasetSpec
from phd_exp.training.build import build_augmentation
from phd_exp.training.config import RunConfig, check

CHOICES = {
    group.name: [f"{group.name}={file.stem}" for file in sorted(group.glob("*.yaml"))]
    for group in sorted(path for path in conf_folder().iterdir() if path.is_dir())
    # these are chosen by other groups
    if group.name not in ("loss", "recipe_at_backbone", "locating_at_preset", "locating_at_data")
}
STRONG = ("recipe=strong", "preset=small")
OF_STRONG = ("recipe_at_preset", "without")
"""The groups that require a strong recipe, one choice at a time; choices of all other groups go with each other."""
TOGETHER = [
    tuple(word for word in words if word)
    for words in zip_longest(*(words for group, words in CHOICES.items() if group not in OF_STRONG))
] + [(*STRONG, word) for group in OF_STRONG for word in CHOICES[group]]
TOGETHER += [("recipe=strong", *words) for words in zip(CHOICES["preset"], cycle(CHOICES["backbone"]), strict=False)]


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


def test_defaults_are_the_authors_protocol(checked: Callable) -> None:
    config = checked()
    assert (config.data.n_train, config.data.n_test, config.data.image_size) == (8000, 2000, 224)
    assert config.data.batch_size == 64
    assert config.trainer.max_epochs == 50
    assert config.backbone["depth"] == 50
    assert config.optimizer["_target_"] == "torch.optim.Adam"
    assert config.optimizer["lr"] == 1e-3
    assert config.camera.focal_length == "known"
    recipe = config.recipe
    assert (recipe.name, recipe.schedule, recipe.warmup_steps, recipe.localisation) == ("paper", "constant", 0, 0)
    assert build_augmentation(recipe) is None


def test_own_objects_have_more_images_wider_networks_and_other_backdrops(checked: Callable, tmp_path: Path) -> None:
    (tmp_path / "part.obj").touch()
    own = ("data=object", f"data.mesh={tmp_path}/part.obj")
    for words, expected in [
        (("preset=small", "recipe=strong", *own), (4800, 100, 24, 1.2, 0.75)),
        (("preset=small", *own), (4800, 100, None, 1.0, 0.0)),
        (("preset=full", "recipe=strong", *own), (8000, 42, 16, 1.2, 0.75)),
        (("preset=small", "recipe=strong"), (3200, 30, 16, 1.0, 0.0)),
        (("preset=small", "recipe=strong", *own, "trainer.max_epochs=2"), (4800, 2, 24, 1.2, 0.75)),
        (("preset=small", "recipe=strong", *own, "backbone.width=8"), (4800, 100, 8, 1.2, 0.75)),
    ]:
        config = checked(*words)
        size = config.data.n_train, config.trainer.max_epochs, config.backbone.get("width")
        augmentation = config.recipe.augmentation
        assert (*size, augmentation.largest_zoom, augmentation.backdrops) == expected, words


@pytest.mark.parametrize(
    ("preset", "depth", "width", "stride"), [("paper", 50, 32, 2), ("small", 10, 16, 4), ("smoke", 10, 16, 4)]
)
def test_the_strong_recipe_keeps_the_depth_and_length_of_its_preset(
    checked: Callable, preset: str, depth: int, width: int, stride: int
) -> None:
    config, plain = checked("recipe=strong", f"preset={preset}"), checked(f"preset={preset}")
    assert plain.evaluation.every_n_epochs == (2 if preset == "small" else 1)
    assert config.backbone["_target_"].endswith("Locating")
    assert [config.backbone[key] for key in ("depth", "width", "stride")] == [depth, width, stride]
    assert config.data.image_size == config.data.spec.sensor_size
    assert config.trainer.max_epochs == plain.trainer.max_epochs


@pytest.mark.parametrize(
    ("model", "loss", "camera", "strong_camera"),
    [
        ("probabilistic", "NegativeLogLikelihood", "known", "shown"),
        ("mae_vz", "MeanAbsoluteError", "known", "shown"),
        ("mae_logz", "MeanAbsoluteError", "known", "shown"),
        ("mae_xyz", "MeanAbsoluteError", "known", "known"),
        ("mae_constf", "MeanAbsoluteError", "constant", "constant"),
    ],
)
def test_a_model_picks_its_loss_and_camera_and_whether_the_strong_recipe_shows_the_focal_length(
    checked: Callable, model: str, loss: str, camera: str, strong_camera: str
) -> None:
    config = checked(f"model={model}")
    assert config.model.name == model
    assert config.loss["_target_"].endswith(loss)
    assert config.camera.focal_length == camera
    assert checked("recipe=strong", f"model={model}").camera.focal_length == strong_camera


@pytest.mark.parametrize(
    ("part", "keys"),
    [
        ("muon", {f"optimizer.{key}" for key in ("_target_", "orthogonal_lr", "momentum", "weight_decay", "fused")}),
        ("weight_decay", {"optimizer.weight_decay"}),
        ("schedule", {"recipe.schedule", "recipe.warmup_steps"}),
        ("localisation", {"recipe.localisation"}),
        ("segmentation", {"recipe.segmentation", "backbone.segments"}),
        ("symmetries", {"recipe.augmentation.symmetries"}),
        ("colours", {"recipe.augmentation.colours"}),
        ("exposure", {"recipe.exposure"}),
        ("focal_length", {"camera.focal_length"}),
        ("fine_images", {"data.image_size", "backbone.width", "backbone.stride", "backbone.channels"}),
    ],
)
def test_without_removes_one_part_of_the_strong_recipe(composed: Callable, part: str, keys: set) -> None:
    whole, without = flatten(composed(*STRONG)), flatten(composed(*STRONG, f"without={part}"))
    changed = {key for key in whole | without if whole.get(key, "none") != without.get(key, "none")}
    assert changed == keys


def test_the_command_line_overrides_all_files(checked: Callable) -> None:
    config = checked("preset=smoke", "backbone=resnet50", "model=mae_vz", "camera=constant", "data.n_train=48")
    assert config.backbone["depth"] == 50
    assert config.camera.focal_length == "constant"
    assert config.data.n_train == 48
    assert config.preset == "smoke"
    strong = checked(*STRONG, "data.image_size=48", "model=mae_logz", "camera=known")
    assert (strong.data.image_size, strong.camera.focal_length) == (48, "known")


@pytest.mark.parametrize("preset", sorted(file.stem for file in (conf_folder() / "preset").glob("*.yaml")))
def test_a_folder_is_used_whole_with_every_preset(checked: Callable, preset: str) -> None:
    own = checked(f"preset={preset}", "data=folder", "data.folder=photos").data
    rendered = checked(f"preset={preset}").data
    assert (own.n_train, own.n_held_out, own.n_test) == (None, 0, None)
    assert (own.image_size, own.batch_size) == (rendered.image_size, rendered.batch_size)


def test_variants_differ_only_in_the_keys_of_their_files(checked: Callable) -> None:
    plain = checked("data=default").data.spec
    changes = {
        "occl": {"occluders"},
        "scale": {"scale_range"},
        "occl_scale": {"occluders", "scale_range"},
        "multiview": {"scale_range", "views", "view_angle_range"},
    }
    for variant, keys in changes.items():
        other = checked(f"data={variant}").data.spec
        differing = {key for key in DatasetSpec.model_fields if getattr(plain, key) != getattr(other, key)}
        assert differing == keys | {"variant"}
        assert other.variant == variant


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
    for name, key in {
        "far": "z_range",
        "long_f": "f_range",
        "grey": "saturation_range",
        "hidden": "half_hidden",
    }.items():
        own, other = config.data.spec, config.data_of(name).spec
        assert {key for key in DatasetSpec.model_fields if getattr(own, key) != getattr(other, key)} == {
            "variant",
            key,
        }
        assert other.variant == f"{data}-{name}"
    assert config.data_of("dark").spec == config.data.spec


def test_older_records_without_several_views_are_valid(composed: Callable[..., dict[str, Any]]) -> None:
    config = composed()
    for key in ("multiview", "shifts", "n_shifted"):
        del config["evaluation"][key]
    for key in ("saturation_range", "half_hidden"):
        del config["data"][key]
    assert check(config).evaluation.multiview is None
    assert check(config) == check(composed()).model_copy(update={"evaluation": check(config).evaluation})


def test_every_configuration_has_the_sections_that_a_report_expects() -> None:
    required = {name for name, one in RunConfig.model_fields.items() if one.is_required()}
    assert set(SECTIONS) == required - {"seed", "runs", "preset", "logger"}  # numbers and names; a logger may be none
