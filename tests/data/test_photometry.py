"""Photometric changes: each does what it is named after, to the share of images that it is drawn for, and no more."""

import io
from collections.abc import Callable

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.stats import norm

from phd_exp.data.jpeg import compressed
from phd_exp.data.photometry import NUMBERS, Photometry, blurred, noisy

N, SIDE = 400, 32


def numbers(n: int = N) -> torch.Tensor:
    return 2 * torch.rand(n, Photometry.n_numbers, generator=torch.Generator().manual_seed(0)) - 1


def images(n: int = N) -> torch.Tensor:
    """Smooth gradients between 60 and 160, other in each channel."""
    ramp = torch.linspace(60, 160, SIDE)
    one = torch.stack(
        [ramp.expand(SIDE, SIDE), ramp[:, None].expand(SIDE, SIDE), ramp.flip(0).expand(SIDE, SIDE)], -1
    )
    return one.round().to(torch.uint8).expand(n, SIDE, SIDE, 3).contiguous()


@pytest.mark.parametrize(
    ("limits", "share"),
    [
        ({"brightness": 2.0}, 1.0), ({"contrast": 2.0}, 1.0), ({"gamma": 2.0}, 1.0),
        ({"white_balance": 1.5}, 1.0), ({"blur": 3.0}, 1 / 4), ({"noise": 20.0}, 1 / 4), ({"jpeg": 20}, 1 / 4),
        ({"occluders": 0.3}, 0.3),
    ],
    ids=lambda value: "" if isinstance(value, float) else next(iter(value)),
)  # fmt: skip
def test_each_change_is_drawn_for_its_share_of_images(limits: dict, share: float) -> None:
    changed = Photometry(**limits)(images(), numbers()).ne(images()).flatten(1).any(1)
    assert changed.float().mean().item() == pytest.approx(share, abs=0.08)
    assert not Photometry().changes_anything
    assert Photometry(**limits).changes_anything


def drawn(number: float, name: str, place: int = 0) -> torch.Tensor:
    """Numbers of one image that draw one change, at this strength, and no other."""
    row = torch.full((1, Photometry.n_numbers), -0.2)  # at which a factor of up to 1.5 is 1
    parts = dict(zip(NUMBERS, row.split(list(NUMBERS.values()), dim=1), strict=True))
    parts[name][0, place] = number
    return row


def value(image: torch.Tensor) -> np.ndarray:
    return image[0].double().numpy() / 255


@pytest.mark.parametrize("number", [-1.0, -0.4, 0.7, 1.0])
def test_tones_follow_their_formulas(number: float) -> None:
    odd = images(1)[:, 1:, 1:].contiguous()  # bytes are looked up in pairs
    before = value(odd)
    factor = np.interp(number, [-1, 1], [1 / 1.5, 1.5])
    expected = {
        0: (Photometry(brightness=1.5), before * factor),
        1: (Photometry(contrast=1.5), 0.5 + (before - 0.5) * factor),
        2: (Photometry(gamma=1.5), before**factor),
        4: (Photometry(white_balance=1.5), before * np.array([1, factor, 1])),
    }
    for place, (photometry, after) in expected.items():
        found = value(photometry(odd, drawn(number, "tone", place)))
        np.testing.assert_allclose(found, after.clip(0, 1), atol=0.51 / 255)


@pytest.mark.parametrize("deviation", [0.2, 0.4, 1.3, 2.5, 6.0])
def test_blur_is_that_of_scipy_within_two_levels(deviation: float) -> None:
    random = torch.Generator().manual_seed(0)
    noise = torch.randint(0, 256, (1, 48, 64, 3), dtype=torch.uint8, generator=random)
    found = blurred(torch.cat([255 - noise, noise]), np.array([2 * deviation, deviation]))[1].double().numpy()
    reach = np.ceil(3 * deviation) / deviation
    expected = gaussian_filter(noise[0].double().numpy(), (deviation, deviation, 0), mode="nearest", truncate=reach)
    assert np.abs(found - expected).max() < 2
    assert np.abs(found - expected).mean() < 0.5
    assert abs((found - expected).mean()) < 0.03


@pytest.mark.parametrize("limits", [{"brightness": 2.0, "gamma": 2.0}, {"white_balance": 2.0}], ids=str)
def test_the_tones_of_an_image_do_not_depend_on_its_batch(limits: dict) -> None:
    before, drawn, photometry = images(9), numbers(9), Photometry(**limits)
    alone = [photometry(before[row : row + 1], drawn[row : row + 1]) for row in range(9)]
    assert torch.equal(photometry(before, drawn), torch.cat(alone))


@pytest.mark.parametrize("deviation", [0.6, 2.0, 10.0, 24.0, 200.0])
def test_noise_is_normal_and_rounded(deviation: float) -> None:
    noise = noisy(
        torch.full((2, 64, 64, 3), 128, dtype=torch.uint8), np.array([deviation, 0.01]), np.array([0.3, 1.0])
    )
    level = np.arange(256)
    share = np.diff(norm.cdf(np.append(level[:1] - np.inf, [*(level[1:] - 0.5), np.inf]), 128, deviation))
    found = np.bincount(noise[0].flatten().numpy(), minlength=256) / noise[0].numel()
    assert np.abs(found.cumsum() - share.cumsum()).max() < 0.02  # 1.36 / sqrt(12288) is 0.012
    assert (noise[1] == 128).all()


def test_an_occluder_hides_a_convex_part_by_one_colour_and_the_original_stays() -> None:
    before = images()
    after = Photometry(occluders=1.0)(before, numbers())
    assert torch.equal(before, images())
    for image, original in zip(after, before, strict=True):
        hidden = image.ne(original).any(-1)
        if hidden.sum() < 40:
            continue  # a sliver
        rows, columns = hidden.nonzero().T
        assert max(int(rows.max() - rows.min()), int(columns.max() - columns.min())) <= SIDE / 2
        assert len(image[hidden].unique(dim=0)) == 1
        middle = rows.double().mean().round().int(), columns.double().mean().round().int()
        assert hidden[middle]  # the centroid of a convex shape lies inside


def by_pillow(image: np.ndarray, quality: int) -> np.ndarray:
    stream = io.BytesIO()
    Image.fromarray(image).save(stream, format="jpeg", quality=quality)
    return np.asarray(Image.open(stream))


@pytest.mark.parametrize("quality", [10, 25, 49, 50, 75, 95, 100])
@pytest.mark.parametrize("size", [(64, 64), (224, 224), (50, 71)], ids=str)
def test_compression_is_that_of_pillow(quality: int, size: tuple[int, int]) -> None:
    random = torch.Generator().manual_seed(0)
    smooth = torch.nn.functional.interpolate(torch.rand(3, 3, 9, 9, generator=random), size, mode="bicubic")
    smooth[1, :, :, size[1] // 2 :] = 1 - smooth[1, :, :, size[1] // 2 :]  # an edge
    noisy = smooth + torch.randn(3, 3, *size, generator=random) * torch.tensor([0, 0.02, 0.1]).view(3, 1, 1, 1)
    before = (255 * noisy.clamp(0, 1)).round().to(torch.uint8).permute(0, 2, 3, 1).contiguous()
    after = compressed(before, np.full(3, float(quality))).int().numpy()
    for one, found in zip(before.numpy(), after, strict=True):
        expected = by_pillow(one, quality).astype(int)
        assert np.abs(found - expected).mean() < 1
        assert np.abs(found - expected).mean() < 0.4 * np.abs(one.astype(int) - expected).mean() + 0.4


@pytest.mark.parametrize(
    ("change", "reference", "tolerance"),
    [
        ({}, lambda image: image, 0),
        ({"brightness": 0.5}, lambda image: 0.5 * image, 0.51 / 255),
        ({"brightness": 2.0}, lambda image: (2 * image).clip(0, 1), 0.51 / 255),
        ({"contrast": 0.5}, lambda image: 0.5 + 0.5 * (image - 0.5), 0.51 / 255),
        ({"gamma": 0.5}, np.sqrt, 0.51 / 255),
        ({"gamma": 2.0}, np.square, 0.51 / 255),
        ({"blur": 2.0}, lambda image: gaussian_filter(image, (2, 2, 0), mode="nearest"), 0.03),
        ({"jpeg": 30}, lambda image: by_pillow((255 * image).round().astype(np.uint8), 30) / 255, 0.03),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_a_fixed_change_changes_every_image_alike(change: dict, reference: Callable, tolerance: float) -> None:
    before = images(5)
    after = Photometry(**change).fixed(before).double().numpy() / 255
    for one in after:
        np.testing.assert_allclose(one, reference(value(before)), atol=tolerance)


def test_fixed_noise_differs_between_images_and_not_between_calls() -> None:
    before = images(8)
    noise = (Photometry(noise=10.0).fixed(before).double() - before).flatten(1)
    np.testing.assert_allclose(noise.std(dim=1), 10, rtol=0.06)
    correlation = np.corrcoef(noise.numpy()) - np.eye(len(noise))
    assert np.abs(correlation).max() < 0.1
    assert (noise == (Photometry(noise=10.0).fixed(before).double() - before).flatten(1)).all()
