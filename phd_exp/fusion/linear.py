"""Sums, products and linear systems of two or three unknowns, one for each problem of a batch.

Written out, because a library call for each of ten thousand 3 x 3 matrices takes longer than the arithmetic, and adds
in an order that depends on the size of the batch: here no problem depends on its neighbours, not in the last bit.
"""

import torch
from jaxtyping import Float
from torch import Tensor

Triangle = list[list[Tensor]]
"""The lower triangle of a matrix, row by row."""


def total(terms: Tensor, dim: int) -> Tensor:
    """A sum in the order of the terms."""
    first, *rest = terms.unbind(dim)
    result = first.clone()
    for term in rest:
        result += term
    return result


def product(A: Float[Tensor, "*#batch m n"], B: Float[Tensor, "*#batch n k"]) -> Float[Tensor, "*#batch m k"]:
    """A B."""
    return total(A[..., None] * B[..., None, :, :], -2)


def apply(A: Float[Tensor, "*#batch m n"], b: Float[Tensor, "*#batch n"]) -> Float[Tensor, "*#batch m"]:
    """A b."""
    return total(A * b[..., None, :], -1)


def solve(H: Triangle, b: Float[Tensor, "k ..."]) -> Float[Tensor, "k ..."]:
    """The x with H x = b, for H symmetric; NaN where it is not positive definite."""
    L = factor(H)
    return backward(L, forward(L, b))


def factor(H: Triangle) -> Triangle:
    """L with L L^T = H."""
    L: Triangle = []
    for i, given in enumerate(H):
        row: list[Tensor] = []
        for j, rest in enumerate(given):
            other = L[j] if j < i else row
            for m in range(j):
                rest = rest - row[m] * other[m]
            row.append(rest / L[j][j] if j < i else rest.sqrt())
        L.append(row)
    return L


def forward(L: Triangle, b: Float[Tensor, "k ..."]) -> Float[Tensor, "k ..."]:
    """The x with L x = b."""
    x = list(b)
    for i, row in enumerate(L):
        for m in range(i):
            x[i] = x[i] - row[m] * x[m]
        x[i] = x[i] / row[i]
    return torch.stack(x)


def backward(L: Triangle, b: Float[Tensor, "k ..."]) -> Float[Tensor, "k ..."]:
    """The x with L^T x = b."""
    x = list(b)
    for i in reversed(range(len(x))):
        for m in range(i + 1, len(x)):
            x[i] = x[i] - L[m][i] * x[m]
        x[i] = x[i] / L[i][i]
    return torch.stack(x)
