"""A camera that is moved sees, when the scene is rendered for it, what augmentation makes of the old picture."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from phd_exp.data.augmentation import moved
from phd_exp.data.batches import Batch
from phd_exp.geometry import Camera
from phd_exp.geometry.motion import Motion, small_turns, symmetries
from phd_exp.records.scenes import Pose, Scene
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.antialias import edges
from phd_exp.rendering.rays import trace_pixels
from phd_exp.rendering.sampling import sample_scene
from tests.support.renders import ROOT, silhouettes

RIM = 3  # px around silhouettes, which bilinear interpolation blurs
NOISE = 1.0  # grey values: of the tracer, whose random numbers differ, and of interpolation

RENDER = """
import sys
import numpy as np
import pytest
from phd_exp.records.scenes import Scene
from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.samples import take_picture
from phd_exp.rendering.rays import trace_pixels
renderer = Renderer(Settings(samples=16, denoised=True, at_middles=True))
scenes = [Scene.model_validate_json(line) for line in sys.stdin]
np.save(sys.argv[1], np.stack([take_picture(renderer, scene, trace_pixels(scene)) for scene in scenes]))
"""


def seen_after(scene: Scene, motion: Motion) -> Scene:
    """The scene as the moved camera sees it."""
    x, y, z, w = Rotation.from_matrix(motion.R[0].double().numpy()).as_quat().tolist()
    pose = Pose(rotation=(w, x, y, z), translation=(0.0, 0.0, 0.0))
    return scene.model_copy(update={"f": scene.f * float(motion.zoom[0]), "pose": pose})


def pictures(folder: Path, *scenes: Scene) -> np.ndarray:
    """By Blender in its own process."""
    lines = "".join(f"{scene.model_dump_json()}\n" for scene in scenes)
    command = [sys.executable, "-c", RENDER, str(folder / "pictures.npy")]
    subprocess.run(command, input=lines, text=True, cwd=ROOT, check=True)
    return np.asarray(np.load(folder / "pictures.npy"))


def difference(picture: np.ndarray, warp: np.ndarray, scene: Scene) -> float:
    """The mean difference of grey values within objects, away from their silhouettes' and their own edges."""
    hits = trace_pixels(scene)
    within = silhouettes(hits) & ~edges(hits.first.astype(np.int8), RIM)
    assert within.sum() > 1000
    return float(np.abs(picture.astype(float) - warp)[within].mean())


@pytest.mark.slow
def test_a_moved_camera_sees_the_warped_picture(make_spec: Callable[..., DatasetSpec], tmp_path: Path) -> None:
    """After a quarter turn, zoom, roll and tilt. A reflection is no motion of a camera."""
    scene = sample_scene(make_spec("occl"), "train", 0)
    camera = Camera(torch.tensor([scene.f], dtype=torch.float64), float(scene.S))
    quarter = symmetries(torch.tensor([[1.0, -1.0, -1.0]], dtype=torch.float64))
    motion = small_turns(torch.tensor([[1.0, 0.7, 0.9, -0.9]], dtype=torch.float64), 1.3, camera).after(quarter)
    assert motion.R.det() > 0
    new_scene = seen_after(scene, motion)
    before, after = pictures(tmp_path, scene, new_scene)
    xyz = torch.zeros(1, 3, dtype=torch.float64)
    batch = Batch(torch.from_numpy(before)[None], xyz, camera.f, camera.S, torch.zeros(1).long())
    assert difference(after, moved(batch, motion).image[0].numpy(), new_scene) < NOISE
    # and no other motion would do
    assert difference(after, before, new_scene) > 5 * NOISE
