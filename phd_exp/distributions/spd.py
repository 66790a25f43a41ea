"""Symmetric positive definite 2 x 2 matrices: the map from three raw numbers, and elementwise linear algebra.

Nothing here calls matmul, which autocast would round to bfloat16 and TF32 to ten bits.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def positive(s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The activation phi(s) = s + 1 for s >= 0, e^s for s < 0.

    Source: paper, section "Enforcing constraints on distribution parameters" (its main text swaps the branches).
    """
    # with l = min(s, 0) the derivative is 1 - l' + l' = 1 at s = 0 whatever autograd takes l' to be there
    low = s.clamp_max(0)
    return s - low + low.exp()


def log_positive(s: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """log phi(s): finite, with its derivative, where phi(s) underflows."""
    low = s.clamp_max(0)
    return torch.log1p(s - low) + low


def spectral_map(b: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2 2"], Float[Tensor, "*batch"]]:
    """B = phi(M), `positive` acting on the eigenvalues of M = [[b_1, b_2/sqrt 2], [b_2/sqrt 2, b_3]], and log|B|.

    With M's eigenvalues s = m +- r, B = (phi(s+) + phi(s-))/2 I + (phi(s+) - phi(s-))/(s+ - s-) (M - m I).
    Value and derivative are exact at equal eigenvalues and at s = 0, where a network with a zero last layer starts.
    log|B| is finite for |b| up to 1e4, where B itself underflows.

    Source: paper, section "Enforcing constraints on distribution parameters"; closed form: own derivation, checked
    by gradcheck in tests/distributions/test_spd.py.
    """
    b_1, b_2, b_3 = b.unbind(-1)
    middle, half, off = (b_1 + b_3) / 2, (b_1 - b_3) / 2, b_2 / math.sqrt(2)
    squared = half.square() + off.square()
    zero = squared == 0
    # everything below is even in r, hence 0 is its true derivative with respect to r at r = 0
    r = squared.masked_fill(zero, 1).sqrt().masked_fill(zero, 0)
    upper, lower = middle + r, middle - r
    mean, slope = (positive(upper) + positive(lower)) / 2, _divided_difference(upper, lower)
    diagonal = slope * half
    B = torch.stack([mean + diagonal, slope * off, slope * off, mean - diagonal], dim=-1)
    return B.unflatten(-1, (2, 2)), log_positive(upper) + log_positive(lower)


def _divided_difference(upper: Tensor, lower: Tensor) -> Tensor:
    """(phi(upper) - phi(lower)) / (upper - lower) for upper >= lower, phi'(upper) where they are equal."""
    equal = upper == lower  # which rounding can make them
    upper_low, lower_low = upper.clamp_max(0), lower.clamp_max(0)
    # phi(s) = (s - l) + e^l with l = min(s, 0): both parts grow with s, so no difference of them cancels
    linear = (upper - upper_low) - (lower - lower_low)
    exponential = upper_low.exp() * -torch.expm1(lower_low - upper_low)
    gap = (upper - lower).masked_fill(equal, 1)
    return torch.where(equal, upper_low.exp(), (linear + exponential) / gap)


def conditioned(b: Float[Tensor, "*batch 3"], ratio: float) -> Float[Tensor, "*batch 3"]:
    """b for which the lesser eigenvalue of `spectral_map` is at least 1/ratio of the greater; others are unchanged.

    The change is a constant for the gradient, so that training can leave the bound.
    """
    b_1, b_2, b_3 = b.detach().unbind(-1)
    half, off = (b_1 - b_3) / 2, b_2 / math.sqrt(2)
    r = (half.square() + off.square()).sqrt()
    upper = (b_1 + b_3) / 2 + r
    log_least = log_positive(upper) - math.log(ratio)
    least = log_least.clamp_max(0) + torch.expm1(log_least.clamp_min(0))  # the s whose phi(s) this is
    raised = (least - (upper - 2 * r)).clamp_min(0) / 2
    cosine, sine = (part / r.masked_fill(r == 0, 1) for part in (half, off))
    return b + raised[..., None] * torch.stack([1 - cosine, -math.sqrt(2) * sine, 1 + cosine], dim=-1)


def matvec(M: Float[Tensor, "*#batch 2 2"], x: Float[Tensor, "*#batch 2"]) -> Float[Tensor, "*#batch 2"]:
    """The product M x."""
    # written out, because a sum over two elements is slower
    return M[..., 0] * x[..., :1] + M[..., 1] * x[..., 1:]


def log_det(M: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch"]:
    """log|M| of a symmetric positive definite matrix, from its Cholesky pivots."""
    pivot = M[..., 0, 0]
    return torch.log(pivot) + torch.log(M[..., 1, 1] - M[..., 0, 1] * M[..., 1, 0] / pivot)


def inverse(M: Float[Tensor, "*batch 2 2"], log_det_M: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 2 2"]:
    """The inverse of a symmetric positive definite matrix whose log determinant is known: adj(M) / |M|."""
    adjugate = torch.stack([M[..., 1, 1], -M[..., 0, 1], -M[..., 1, 0], M[..., 0, 0]], dim=-1)
    root = torch.exp(-log_det_M / 2)[..., None, None]  # of 1/|M|, which may itself overflow
    return adjugate.unflatten(-1, (2, 2)) * root * root


def square(M: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 2 2"]:
    """The product M M."""
    return (M[..., :, :, None] * M[..., None, :, :]).sum(dim=-2)
