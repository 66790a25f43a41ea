"""The raw numbers of turned and mirrored images, brought back: exact, number by number and as a density."""

import pytest
import torch

from phd_exp.geometry import Camera, DepthScale
from phd_exp.geometry.motion import EIGHT, symmetries, turned
from phd_exp.models.heads import DistributionHead, SurrogateHead

DEPTH = DepthScale.from_ranges(f_range=(1200.0, 2000.0), z_range=(3.0, 5.0))
HEADS = [DistributionHead(DEPTH), DistributionHead(DEPTH, free_axis=True), SurrogateHead(DEPTH, is_rounded=True)]
every_head = pytest.mark.parametrize("head", HEADS, ids=["seven numbers", "nine", "ten"])
SIGNS = torch.tensor(EIGHT, dtype=torch.float64)
CAMERA = Camera(torch.full((8,), 1500.0, dtype=torch.float64), 224.0)


def test_the_first_symmetry_is_the_identity_and_all_eight_differ() -> None:
    R = symmetries(SIGNS).R
    torch.testing.assert_close(R[0], torch.eye(3, dtype=torch.float64))
    assert len({tuple(matrix.flatten().tolist()) for matrix in R}) == 8


@every_head
@pytest.mark.parametrize("seed", range(3))
def test_the_density_at_a_position_is_that_of_the_view_at_the_turned_position(
    seed: int, head: DistributionHead
) -> None:
    draw = torch.Generator().manual_seed(seed)
    raw = 3 * torch.randn(head.n_outputs, generator=draw, dtype=torch.float64).expand(8, -1)
    xyz = torch.tensor([0.1, -0.2, 4.0]) + 0.1 * torch.randn(8, 3, generator=draw, dtype=torch.float64)
    of_view = head(raw, CAMERA)  # eight networks that give the same numbers for eight views
    back = head(head.turned_back(raw, SIGNS), CAMERA)
    torch.testing.assert_close(back.log_prob(xyz), of_view.log_prob(symmetries(SIGNS).position(xyz)))


@every_head
def test_bringing_back_moves_numbers_and_changes_signs_alone(head: DistributionHead) -> None:
    raw = torch.tensor([1.0, 2, 4, 8, 16, 32, -64, 128, 256, -512])[: head.n_outputs]
    for back in head.turned_back(raw.expand(8, -1), SIGNS.float()):
        assert sorted(back.abs().tolist()) == sorted(raw.abs().tolist())
        assert back[5:7].tolist() == [32, -64]
        assert back[9:].tolist() == raw[9:].tolist()


def test_a_pixel_of_a_turned_image_lies_at_the_turned_position() -> None:
    side, (row, column) = 6, (1, 4)
    image = torch.zeros(side, side, 3, dtype=torch.uint8)
    image[row, column] = 255
    ray = torch.tensor([column + 0.5 - side / 2, row + 0.5 - side / 2, 1.0], dtype=torch.float64)
    for signs, new in zip(EIGHT, symmetries(SIGNS).position(ray.expand(8, 3)), strict=True):
        (at,) = turned(image, signs)[..., 0].nonzero()
        assert at.tolist() == [int(new[1] + side / 2), int(new[0] + side / 2)]
