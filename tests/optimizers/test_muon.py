"""The orthogonal step, held against an SVD, against torch's own of matrices, and Adam's against torch's."""

import pytest
import torch
from torch import Tensor, nn

from phd_exp.optimizers.muon import Muon, orthogonal


def network() -> nn.Sequential:
    torch.manual_seed(3)
    return nn.Sequential(nn.Conv2d(3, 8, 3), nn.Conv2d(8, 16, 3), nn.Conv2d(16, 2, 1))


def descend(model: nn.Module, optimizer: torch.optim.Optimizer, steps: int) -> None:
    pixels = torch.randn(4, 3, 9, 9, generator=torch.Generator().manual_seed(5))
    for _ in range(steps):
        optimizer.zero_grad()
        model(pixels).square().mean().backward()
        optimizer.step()


@pytest.mark.parametrize("shape", [(32, 288), (64, 64), (96, 24)])
def test_singular_values_come_near_one_and_vectors_stay(shape: tuple[int, int]) -> None:
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    U, S, Vh = torch.linalg.svd(matrix, full_matrices=False)
    rotated = U.T @ orthogonal([matrix])[0] @ Vh.T
    found = rotated.diagonal()
    large = S.norm() / 500 < S
    assert large.sum() >= len(S) - 1
    assert found[large].min() > 0.6
    assert found.max() < 1.3
    torch.testing.assert_close(rotated, found.diag(), atol=2e-3, rtol=0)


def test_matrices_iterated_together_are_those_iterated_alone() -> None:
    generator = torch.Generator().manual_seed(6)
    matrices = [torch.randn(shape, generator=generator) for shape in [(8, 72), (16, 8), (8, 8), (72, 8), (16, 144)]]
    for together, matrix in zip(orthogonal(matrices), matrices, strict=True):
        torch.testing.assert_close(together, orthogonal([matrix])[0])


def test_no_gradient_is_no_step() -> None:
    assert torch.equal(orthogonal([torch.zeros(4, 6)])[0], torch.zeros(4, 6))


@pytest.mark.parametrize("decay", [0.0, 5.0])
def test_a_convolution_steps_as_a_matrix_of_torchs_muon(decay: float) -> None:
    start, *gradients = torch.randn(4, 16, 8 * 9, generator=torch.Generator().manual_seed(2))
    ours, theirs = nn.Parameter(start.view(16, 8, 3, 3).clone()), nn.Parameter(start.clone())
    mine = Muon([ours], lr=1.0, orthogonal_lr=0.01, weight_decay=decay)
    torchs = torch.optim.Muon([theirs], lr=0.01, weight_decay=decay, adjust_lr_fn="match_rms_adamw")
    for gradient in gradients:
        ours.grad, theirs.grad = gradient.view_as(ours).clone(), gradient.clone()
        mine.step()
        torchs.step()
    difference = ours.detach().flatten(1) - theirs.detach()
    assert difference.norm() < 0.02 * (theirs.detach() - start).norm()  # theirs iterates in bfloat16


def test_all_else_steps_as_adam_does() -> None:
    one, other = network(), network()
    mine = Muon(one.parameters(), lr=0.01, orthogonal_lr=1e-30, weight_decay=1.0)  # a step of nothing in the middle
    adam = torch.optim.Adam([p for p in other.parameters() if p is not other[1].weight], lr=0.01, fused=True)
    descend(one, mine, steps=5)
    descend(other, adam, steps=5)
    for a, b in zip(one.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_only_what_mixes_features_steps_orthogonally() -> None:
    model = network()
    others, convolutions = Muon(model.parameters(), lr=0.1, orthogonal_lr=0.2).param_groups
    assert [p.shape for p in convolutions["params"]] == [(16, 8, 3, 3)]
    assert (others["lr"], convolutions["lr"]) == (0.1, 0.2)
    assert len(others["params"]) == 5


def test_a_network_without_either_kind_has_one_group() -> None:
    assert len(Muon([nn.Parameter(torch.zeros(3))], lr=0.1, orthogonal_lr=0.1).param_groups) == 1
    assert len(Muon([nn.Parameter(torch.zeros(4, 4, 1, 1))], lr=0.1, orthogonal_lr=0.1).param_groups) == 1


def test_channels_last_makes_the_same_step() -> None:
    def stepped(layout: torch.memory_format) -> Tensor:
        model = network().to(memory_format=layout)
        descend(model, Muon(model.parameters(), lr=0.01, orthogonal_lr=0.01), steps=2)
        return model[1].weight.detach()

    torch.testing.assert_close(stepped(torch.channels_last), stepped(torch.contiguous_format), rtol=1e-4, atol=1e-5)
