"""Builds what trains a checked configuration: data, augmentation and module; `trainer.py` builds the Trainer."""

from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from inspect import isclass
from typing import Any

import torch
from torch import Tensor

from phd_exp.build import build_regressor, build_source, naming, recorded_constants
from phd_exp.config import RenderedConfig, RunConfig
from phd_exp.config.sections import DataConfig, RecipeConfig
from phd_exp.config.targets import build, custom_parts, locate
from phd_exp.data.augmentation import Augmentation
from phd_exp.data.datamodule import PositionData
from phd_exp.data.photographs import Photographs
from phd_exp.data.photometry import Photometry
from phd_exp.data.sources import Source
from phd_exp.geometry.camera import Camera
from phd_exp.models.backbones import Backbone
from phd_exp.models.weights import fill, regressor_weights
from phd_exp.records.errors import ConfigError, RunError
from phd_exp.records.runs import RunFolder
from phd_exp.training.cameras import CameraPolicy
from phd_exp.training.module import PositionModule
from phd_exp.training.objective import Objective, factor

EXCHANGED = {"backdrops", "plain", "prints"}  # shares of a recipe's augmentation that are arguments of `PositionData`


def build_data(config: RunConfig, rank: int = 0) -> PositionData:
    """The data set of a run, or of one of its processes. `setup` opens the images.

    Raises RunError if the run to start from has no constants.
    """
    source = build_source(config.data)
    if config.init:
        source.depth, source.constant_f = recorded_constants(RunFolder(config.init))
    return PositionData(
        source,
        batch_size=config.data.batch_size,
        seed=config.seed,
        rank=rank,
        world=config.trainer.devices,
        augment=build_augmentation(config.recipe),
        held_out=config.evaluation.held_out and config.data.n_held_out > 0,
        masks=config.recipe.segmentation > 0,
        **config.recipe.augmentation.model_dump(include=EXCHANGED),
        photographs=_photographs(config.data),
    )


def _photographs(data: DataConfig) -> Photographs | None:
    """The photographs to train on in addition to renders, if any."""
    asked = data.photographs if isinstance(data, RenderedConfig) else None
    if asked is None or asked.folder is None:
        return None
    return Photographs(asked.folder, asked.object, data.image_size, asked.share)


def build_augmentation(recipe: RecipeConfig) -> Augmentation | None:
    """The augmentation of a recipe; None if it changes nothing."""
    keys = recipe.augmentation.model_dump(exclude=EXCHANGED)
    photometry = Photometry(**{field.name: keys.pop(field.name) for field in fields(Photometry)})
    augmentation = Augmentation(**keys, photometry=photometry)
    return augmentation if augmentation.changes_anything else None


def build_module(config: RunConfig, data: PositionData) -> PositionModule:
    """The network, its loss and its optimizer, initialised from torch's current random state.

    Raises ConfigError, naming the key, for values that a part refuses, and if the run to start from has
    another network.
    """
    recipe, regressor = config.recipe, build_regressor(config, data.source.depth, is_new=config.init is None)
    if config.init:
        start = RunFolder(config.init).best_checkpoint
        try:
            fill(regressor, regressor_weights(start), start)
        except RunError as error:
            name = RunFolder(config.init).config()["model"]["name"]
            raise ConfigError(
                f"init: {error}; expected model={name}, and no words for the network, which is that of the run"
            ) from None
    with naming("optimizer", config.optimizer):
        optimizer = build(config.optimizer, is_partial=True)
        optimizer(regressor.parameters())  # refuses bad values before hours of rendering
    with naming("loss", config.loss):
        # a class makes a loss, a function is one
        loss = build(config.loss, is_partial=not isclass(locate(config.loss["_target_"], None)))
    _require_maps(recipe, regressor.backbone)
    constant_f = data.source.constant_f if config.camera.focal_length == "constant" else None
    module = PositionModule(
        regressor,
        Objective(loss, recipe.localisation, recipe.segmentation),
        CameraPolicy(constant_f, config.camera.f_error),
        optimizer,
        partial(factor, recipe.schedule, recipe.warmup_steps),
    )
    if custom_parts({"head": config.model.head, "backbone": config.backbone, "loss": config.loss}):
        _try_out(module, config, data.source)
    return module


def _require_maps(recipe: RecipeConfig, backbone: Backbone) -> None:
    """Raise ConfigError for the weight of a loss of a map that the backbone lacks."""
    for key, weight, has_map in (
        ("localisation", recipe.localisation, backbone.locates),
        ("segmentation", recipe.segmentation, backbone.segments),
    ):
        if weight and not has_map:
            raise ConfigError(
                f"recipe.{key}: got {weight}, but this backbone has no map of the object; expected 0, or a backbone "
                "that has one, as in conf/recipe/strong.yaml"
            )


@torch.no_grad()
def _try_out(module: PositionModule, config: RunConfig, source: Source) -> None:
    """Call the user's parts on two black images, before hours of rendering. Raises ConfigError naming the key."""
    side, regressor = config.data.image_size, module.regressor.eval()
    xyz = torch.tensor([[0.0, 0.0, source.depth.z_centre]]).expand(2, 3)
    with naming("backbone", config.backbone):
        output = regressor.see(torch.zeros(2, side, side, 3, dtype=torch.uint8))
        _require(output.features, [(2, regressor.backbone.n_features)])
    with naming("model.head", config.model.head):
        prediction = regressor.prediction(output, Camera(torch.full((2,), source.constant_f), float(side)))
        _require(prediction.mode, [(2, 3)])
    with naming("loss", config.loss):
        _require(module.loss(prediction, xyz), [(2,), ()])
    regressor.train()


def _require(values: Any, shapes: Sequence[tuple[int, ...]]) -> None:
    if not isinstance(values, Tensor) or tuple(values.shape) not in shapes:
        given = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
        raise ValueError(f"returned {given} for 2 images; expected {' or '.join(map(str, shapes))}")
    if not values.isfinite().all():
        raise ValueError("returned numbers that are not finite for black images")
