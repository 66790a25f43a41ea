"""Other cameras at the same place: what they see and where things are agree."""

import pytest
import torch
from torch.testing import assert_close

from phd_exp.geometry import Camera
from phd_exp.geometry.motion import Motion, small_turns, symmetries

N = 400
SIDE = 224.0


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture
def camera() -> Camera:
    return Camera(torch.empty(N, dtype=torch.float64).uniform_(1200, 2000), SIDE)


@pytest.fixture
def xyz(camera: Camera) -> torch.Tensor:
    pixel = SIDE * torch.rand(N, 2, dtype=torch.float64)
    return camera.unproject(pixel, torch.empty(N, dtype=torch.float64).uniform_(3, 5))


def numbers(columns: int) -> torch.Tensor:
    """Uniform from -1 to 1, the ends among them."""
    drawn = 2 * torch.rand(N, columns, dtype=torch.float64) - 1
    drawn[: N // 4] = drawn[: N // 4].sign()
    return drawn


@pytest.fixture(params=["symmetries", "turns", "both"])
def motion(request: pytest.FixtureRequest, camera: Camera) -> Motion:
    symmetry, turn = symmetries(numbers(3)), small_turns(numbers(4), 1.5, camera)
    return {"symmetries": symmetry, "turns": turn, "both": turn.after(symmetry)}[request.param]


def from_middle(pixel: torch.Tensor) -> torch.Tensor:
    return 2 * pixel / SIDE - 1


def test_a_position_is_seen_where_its_pixel_goes(motion: Motion, camera: Camera, xyz: torch.Tensor) -> None:
    """The map of pixels is the one that projection before and after the motion makes."""
    seen = from_middle(motion.camera(camera).project(motion.position(xyz)))
    of_all = motion.origin(seen, camera)
    back = of_all[torch.arange(N), torch.arange(N)]
    assert_close(back, from_middle(camera.project(xyz)))
    assert_close(motion.R @ motion.R.mT, torch.eye(3, dtype=torch.float64).expand(N, 3, 3))


def farthest(motion: Motion, camera: Camera) -> torch.Tensor:
    """Place of the corners of the new image in the old one: a homography maps a square to a convex quadrilateral."""
    corners = torch.tensor([[-1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [1.0, -1.0]], dtype=torch.float64)
    return motion.origin(corners, camera).abs().amax((1, 2))


@pytest.mark.parametrize("largest_zoom", [1.0, 1.05, 1.3, 1.5, 3.0])
def test_the_old_image_holds_what_the_new_one_shows(largest_zoom: float, camera: Camera) -> None:
    turns = small_turns(numbers(4), largest_zoom, camera)
    assert (farthest(turns, camera) <= 1 + 1e-6).all()
    assert (turns.zoom <= largest_zoom).all()


def test_roll_and_turns_use_the_room_that_a_zoom_leaves(camera: Camera) -> None:
    extremes = torch.tensor([[1.0, 1.0, 0.0, 0.0], [1.0, 0.0, 1.0, 0.0]], dtype=torch.float64)
    rolled, tilted = (small_turns(row.expand(N, 4), 1.3, camera) for row in extremes)
    assert_close(farthest(rolled, camera), torch.ones(N, dtype=torch.float64))
    assert (farthest(tilted, camera) > 0.95).all()


def test_there_are_eight_symmetries() -> None:
    R = symmetries(torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)).R
    assert len(R.unique(dim=0)) == 8
    assert_close(R.det().abs(), torch.ones(8))
