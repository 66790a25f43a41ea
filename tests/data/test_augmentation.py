"""Augmented batches: pixels and labels belong together."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from phd_exp.data.augmentation import Augmentation, moved
from phd_exp.data.backdrops import BACKDROP_NUMBERS, Backdrops, before_others
from phd_exp.data.batches import Batch, Exchange
from phd_exp.data.photometry import Photometry
from phd_exp.geometry import Camera
from phd_exp.geometry.motion import symmetries

SIDE = 48
N = 64
PLAIN = Photometry()


def spots(camera: Camera, xyz: torch.Tensor) -> torch.Tensor:
    """Images that show a soft white spot where a position is seen."""
    pixel = camera.project(xyz)
    middles = torch.arange(SIDE) + 0.5
    distance = (middles[None, :] - pixel[:, :1]).square()[:, None] + (middles[None, :] - pixel[:, 1:]).square()[
        :, :, None
    ]
    return (255 * (-distance / 18).exp()).round().to(torch.uint8)[..., None].repeat(1, 1, 1, 3)


def spot_of(image: torch.Tensor) -> torch.Tensor:
    """The middle of the spot, by its brightness."""
    weight = image[..., 0].double()
    middles = torch.arange(SIDE) + 0.5
    total = weight.sum((1, 2))
    return torch.stack([(weight * middles).sum((1, 2)), (weight.mT * middles).sum((1, 2))], -1) / total[:, None]


def augmented(batch: Batch, largest_zoom: float, seed: int) -> Batch:
    augment = Augmentation(symmetries=True, largest_zoom=largest_zoom, colours=False, photometry=PLAIN)
    return augment(batch, numbers(seed))


def numbers(seed: int) -> torch.Tensor:
    return 2 * torch.rand(N, Augmentation.n_numbers, generator=torch.Generator().manual_seed(seed)) - 1


@pytest.fixture
def batch() -> Batch:
    torch.manual_seed(0)
    f = torch.empty(N).uniform_(1200, 2000) * SIDE / 224
    camera = Camera(f, float(SIDE))
    # far enough from the border that the whole spot stays in view
    xyz = camera.unproject(SIDE * torch.empty(N, 2).uniform_(0.35, 0.65), torch.empty(N).uniform_(3, 5))
    return Batch(spots(camera, xyz), xyz, f, float(SIDE), torch.arange(N))


@pytest.fixture
def noise(batch: Batch) -> Batch:
    return replace(batch, image=torch.randint(0, 256, batch.image.shape, dtype=torch.uint8))


@pytest.mark.parametrize("largest_zoom", [1.0, 1.3])
def test_the_object_is_where_its_label_says(batch: Batch, largest_zoom: float) -> None:
    new = augmented(batch, largest_zoom, seed=1)
    assert_close(spot_of(new.image), new.camera.project(new.xyz).double(), rtol=0, atol=0.05)
    assert not torch.equal(new.image, batch.image)
    assert ((new.f > batch.f).any()) == (largest_zoom > 1)


@pytest.mark.parametrize("largest_zoom", [1.0, 1.3])
def test_a_mask_moves_as_its_image(noise: Batch, largest_zoom: float) -> None:
    grey = noise.image[..., :1].repeat(1, 1, 1, 3)
    new = augmented(replace(noise, image=grey, mask=grey[..., 0]), largest_zoom, seed=1)
    assert not torch.equal(new.mask, grey[..., 0])
    assert torch.equal(new.mask, new.image[..., 0])
    assert torch.equal(new.select(slice(3)).mask, new.mask[:3])


def test_symmetries_move_pixels_as_they_are(noise: Batch) -> None:
    there = noise.image
    expected = {
        (1, 1, 1): there,
        (-1, 1, 1): there.flip(2),
        (1, -1, 1): there.flip(1),
        (1, 1, -1): there.transpose(1, 2),
        (-1, -1, -1): there.transpose(1, 2).flip(1, 2),
    }
    for signs, image in expected.items():
        new = moved(noise, symmetries(torch.tensor([signs], dtype=torch.float32).expand(N, 3)))
        assert torch.equal(new.image, image), signs


def test_symmetries_alone_are_those_of_the_camera(noise: Batch) -> None:
    """Pixels are moved without a warp then; the two ways agree to the bit."""
    new, expected = augmented(noise, 1.0, seed=1), moved(noise, symmetries(numbers(1)[:, :3]))
    assert torch.equal(new.image, expected.image)
    assert_close(new.xyz, expected.xyz)
    assert len((numbers(1)[:, :3] < 0).unique(dim=0)) == 8


def test_objects_stay_in_view(batch: Batch) -> None:
    border = batch.camera.unproject(torch.full((N, 2), SIDE - 0.5), torch.full((N,), 4.0))
    new = augmented(replace(batch, xyz=border), 1.4, seed=1)
    assert new.camera.contains(new.xyz).all()


def test_colours_change_places_alone(noise: Batch) -> None:
    new = Augmentation(symmetries=False, largest_zoom=1.0, colours=True, photometry=PLAIN)(noise, numbers(1))
    assert torch.equal(new.xyz, noise.xyz)
    assert torch.equal(new.image.sort(-1).values, noise.image.sort(-1).values)
    orders = {tuple(new.image[row, 0, 0].tolist()) == tuple(noise.image[row, 0, 0].tolist()) for row in range(N)}
    assert orders == {True, False}
    # one order for all pixels of an image
    first = [noise.image[0, ..., channel] for channel in range(3)]
    assert all(any(torch.equal(new.image[0, ..., channel], one) for one in first) for channel in range(3))


@pytest.mark.parametrize("largest_zoom", [1.0, 1.2])
def test_all_of_it_happens_where_the_images_are(noise: Batch, largest_zoom: float) -> None:
    """On a device without values: whatever reads one, or mixes in a tensor of the host, raises an error."""
    everything = Photometry(0.5, 2.0, 2.0, 2.0, 1.5, 2.5, 15.0, 25)
    augment = Augmentation(symmetries=True, largest_zoom=largest_zoom, colours=True, photometry=everything)
    backdrops, batch = Backdrops(noise.image, noise.image[..., 0]), replace(noise, mask=noise.image[..., 0])
    there = backdrops.to(torch.device("meta"))
    vars(there)["texture"] = backdrops.texture  # read once, before the first step
    exchange = Exchange(there, before_others, BACKDROP_NUMBERS, 0.5, augment)
    new = exchange(batch.to("meta"), 2 * torch.rand(N, exchange.n_numbers, dtype=torch.float64) - 1)
    for name in ("image", "xyz", "f", "mask"):
        found, expected = getattr(new, name), getattr(batch, name)
        assert (found.device.type, found.shape, found.dtype) == ("meta", expected.shape, expected.dtype)
