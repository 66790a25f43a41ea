"""A camera that is moved sees, when the scene is rendered for it, what augmentation makes of the old picture."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from phd_exp.data.augmentation import warped
from phd_exp.data.batches import Batch
from phd_exp.geometry import Camera
from phd_exp.geometry.motion import Motion, small_turns, symmetries
from phd_exp.records.scenes import Lamp, Pose, Scene, SceneObject
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.antialias import edges
from phd_exp.rendering.rays import trace_pixels
from phd_exp.rendering.sampling import sample_scene
from tests.support.renders import silhouettes

HOME = Path(__file__).parents[2]
RIM = 3  # px around silhouettes, which bilinear interpolation blurs
NOISE = 1.0  # grey values: of the tracer, whose random numbers differ, and of interpolation

RENDER = """
import sys
import numpy as np
from phd_exp.records.scenes import Scene
from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.samples import take_picture
from phd_exp.rendering.rays import trace_pixels
renderer = Renderer(Settings(samples=16, denoised=True, at_middles=True))
scenes = [Scene.model_validate_json(line) for line in sys.stdin]
np.save(sys.argv[1], np.stack([take_picture(renderer, scene, trace_pixels(scene)) for scene in scenes]))
"""


def mirrored(scene: Scene) -> Scene:
    """Right and left exchanged, for shapes that are their own mirror images."""

    def flip(place: tuple[float, float, float]) -> tuple[float, float, float]:
        return -place[0], place[1], place[2]

    def turned(item: SceneObject) -> SceneObject:
        w, x, y, z = item.rotation
        return item.model_copy(update={"position": flip(item.position), "rotation": (w, x, -y, -z)})

    def lit(lamp: Lamp) -> Lamp:
        return lamp.model_copy(update={"position": flip(lamp.position), "towards": flip(lamp.towards)})

    changes = {"objects": tuple(map(turned, scene.objects)), "lamps": tuple(map(lit, scene.lamps))}
    return scene.model_copy(update=changes)


def seen_after(scene: Scene, motion: Motion) -> Scene:
    """The scene as the moved camera sees it: mirrored first where the motion is a reflection."""
    R = motion.R[0].double().numpy()
    if np.linalg.det(R) < 0:
        scene, R = mirrored(scene), R @ np.diag([-1.0, 1.0, 1.0])
    x, y, z, w = Rotation.from_matrix(R).as_quat().tolist()
    pose = Pose(rotation=(w, x, y, z), translation=(0.0, 0.0, 0.0))
    return scene.model_copy(update={"f": scene.f * float(motion.zoom[0]), "pose": pose})


def motions(camera: Camera) -> dict[str, Motion]:
    def signs(*values: float) -> Motion:
        return symmetries(torch.tensor([values], dtype=torch.float64))

    turn = small_turns(torch.tensor([[1.0, 0.7, 0.9, -0.9]], dtype=torch.float64), 1.3, camera)
    return {"mirror": signs(-1, 1, 1), "quarter turn, zoom, roll and tilt": turn.after(signs(1, -1, -1))}


@pytest.fixture(scope="module")
def scene(make_spec: Callable[..., DatasetSpec]) -> Scene:
    return sample_scene(make_spec("occl"), "train", 0)


@pytest.fixture(scope="module")
def camera(scene: Scene) -> Camera:
    return Camera(torch.tensor([scene.f], dtype=torch.float64), float(scene.S))


@pytest.fixture(scope="module")
def pictures(scene: Scene, camera: Camera, tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """The scene, and what each moved camera sees of it; Blender in a process of its own."""
    file = tmp_path_factory.mktemp("moved") / "pictures.npy"
    moved = {name: seen_after(scene, motion) for name, motion in motions(camera).items()}
    scenes = {"as it is": scene} | moved
    lines = "".join(f"{item.model_dump_json()}\n" for item in scenes.values())
    subprocess.run([sys.executable, "-c", RENDER, str(file)], input=lines, text=True, cwd=HOME, check=True)
    return dict(zip(scenes, np.load(file), strict=True))


def difference(picture: np.ndarray, warp: np.ndarray, scene: Scene) -> float:
    """The mean difference of grey values within objects, away from their silhouettes' and their own edges."""
    first = trace_pixels(scene).first
    within = silhouettes(trace_pixels(scene)) & ~edges(first.astype(np.int8), RIM)
    assert within.sum() > 1000
    return float(np.abs(picture.astype(float) - warp)[within].mean())


@pytest.mark.parametrize("name", ["mirror", "quarter turn, zoom, roll and tilt"])
def test_a_moved_camera_sees_the_warped_picture(
    scene: Scene, camera: Camera, pictures: dict[str, np.ndarray], name: str
) -> None:
    motion = motions(camera)[name]
    image = torch.from_numpy(pictures["as it is"])[None]
    batch = Batch(image, torch.zeros(1, 3), camera.f, camera.S, torch.zeros(1, dtype=torch.long))
    moved = seen_after(scene, motion)
    assert difference(pictures[name], warped(batch, motion)[0].numpy(), moved) < NOISE
    # and no other motion would do
    assert difference(pictures[name], pictures["as it is"], moved) > 5 * NOISE
