"""Muon: each layer steps along its orthogonalised momentum, equally far in all directions of its output."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Annotated

import torch
from annotated_types import Ge, Gt, Lt
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.adam import adam

_QUINTIC = (3.4445, -4.7750, 2.0315)
"""Coefficients of the polynomial that is steepest at zero: Jordan et al., "Muon" (2024)."""
_ROUNDS = 5
_FEWEST_CHANNELS = 4


class Muon(Optimizer):
    """Orthogonal steps for convolutions between features, Adam for all other parameters.

    A convolution is the matrix (channels out, channels in x kernel). Its step is the Nesterov momentum with singular
    values close to 1, scaled to the root mean square of Adam's steps. Adam updates convolutions that read pixels or
    have few outputs, and all vectors.

    `torch.optim.Muon` takes matrices only and iterates on them in bfloat16, which is slow on most CPUs. Here the
    iteration is on their Gram matrices in float32, with a third of the arithmetic.

    Args:
        params: parameters of the network.
        lr: learning rate of Adam.
        orthogonal_lr: learning rate of the orthogonal steps.
        momentum: weight of the previous mean of gradients.
        weight_decay: each orthogonal step first multiplies the weights by 1 - orthogonal_lr weight_decay.

    Examples:
        >>> network = nn.Sequential(nn.Conv2d(3, 8, 3), nn.Conv2d(8, 8, 3))
        >>> optimizer = Muon(network.parameters(), lr=0.002, orthogonal_lr=0.005)
        >>> network(torch.ones(1, 3, 8, 8)).sum().backward()
        >>> optimizer.step()

    Source: Jordan et al., "Muon: an optimizer for hidden layers in neural networks" (2024); the scale is that of
    Liu et al., "Muon is scalable for LLM training" (2025); the iteration on Gram matrices is an own derivation.
    """

    def __init__(
        self,
        params: Iterable[nn.Parameter],
        lr: Annotated[float, Gt(0)],
        orthogonal_lr: Annotated[float, Gt(0)],
        momentum: Annotated[float, Ge(0), Lt(1)] = 0.95,
        weight_decay: Annotated[float, Ge(0)] = 0.0,
    ) -> None:
        convolutions: list[nn.Parameter] = []
        others: list[nn.Parameter] = []
        for weight in params:
            (convolutions if _mixes_features(weight) else others).append(weight)
        groups = [{"params": others, "lr": lr}, {"params": convolutions, "lr": orthogonal_lr}]
        defaults = {"momentum": momentum, "weight_decay": weight_decay}
        super().__init__([group for group in groups if group["params"]], defaults)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            weights = [weight for weight in group["params"] if weight.grad is not None]
            if not weights:
                continue
            if _mixes_features(weights[0]):
                torch._foreach_mul_(weights, 1 - group["lr"] * group["weight_decay"])
                self._orthogonal_step(weights, group["lr"], group["momentum"])
            else:
                self._adam_step(weights, group["lr"])
        return loss

    def _orthogonal_step(self, weights: list[nn.Parameter], lr: float, momentum: float) -> None:
        ahead = []
        for weight, gradient in zip(weights, _gradients(weights), strict=True):
            state = self.state[weight]
            if not state:
                state["mean"] = torch.zeros_like(weight)
            state["mean"].lerp_(gradient, 1 - momentum)
            ahead.append(torch.lerp(gradient, state["mean"], momentum).flatten(1))
        for weight, step in zip(weights, orthogonal(ahead), strict=True):
            weight.add_(step.view(weight.shape), alpha=-lr * 0.2 * math.sqrt(max(step.shape)))

    def _adam_step(self, weights: list[nn.Parameter], lr: float) -> None:
        for weight in weights:
            state = self.state[weight]
            if not state:
                state["step"] = torch.zeros((), dtype=torch.float32, device=weight.device)
                state["mean"], state["square"] = torch.zeros_like(weight), torch.zeros_like(weight)
        states = [self.state[weight] for weight in weights]
        adam(
            [*weights], _gradients(weights),
            [state["mean"] for state in states], [state["square"] for state in states], [],
            [state["step"] for state in states],
            fused=True, amsgrad=False, beta1=0.9, beta2=0.999, lr=lr, weight_decay=0.0, eps=1e-8, maximize=False,
        )  # fmt: skip


def orthogonal(matrices: Sequence[Float[Tensor, "_ _"]]) -> list[Float[Tensor, "_ _"]]:
    """Nearly U V^T of each matrix U S V^T: singular values from 0.6 to 1.3, of all above a 500th of its norm.

    The Newton-Schulz iteration X <- (a + b X X^T + c (X X^T)^2) X multiplies X by polynomials of G = X X^T only.
    Their product is accumulated in one matrix of the size of G and multiplied by X at the end. Matrices with G of one
    size are iterated together, since most are so small that calls take longer than arithmetic.
    """
    units = [matrix / matrix.norm().clamp_min(torch.finfo(matrix.dtype).tiny) for matrix in matrices]
    grams = [unit.T @ unit if unit.shape[0] > unit.shape[1] else unit @ unit.T for unit in units]
    polynomials = {
        size: iter(_polynomial(torch.stack([gram for gram in grams if len(gram) == size])))
        for size in {*map(len, grams)}
    }
    results = []
    for unit, gram in zip(units, grams, strict=True):
        polynomial = next(polynomials[len(gram)])
        results.append(polynomial @ unit if len(unit) == len(gram) else unit @ polynomial)
    return results


def _polynomial(gram: Float[Tensor, "n size size"]) -> Float[Tensor, "n size size"]:
    """The product of the iteration's polynomials of Gram matrices."""
    a, b, c = _QUINTIC
    product = one = torch.eye(gram.shape[-1], dtype=gram.dtype, device=gram.device)
    for _ in range(_ROUNDS):
        factor = torch.baddbmm(a * one + b * gram, gram, gram, alpha=c)
        product = factor @ product
        gram = factor @ (factor @ gram)
    return product


def _mixes_features(weight: Tensor) -> bool:
    return weight.ndim == 4 and min(weight.shape[:2]) >= _FEWEST_CHANNELS


def _gradients(weights: list[nn.Parameter]) -> list[Tensor]:
    return [weight.grad for weight in weights if weight.grad is not None]
