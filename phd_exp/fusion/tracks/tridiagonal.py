"""Symmetric positive definite matrices that couple each frame with the next one alone: block tridiagonal.

Such a matrix of N frames with d unknowns each is `diagonal` (N x d x d) and `coupling` (N-1 x d x d), the block of
frame k+1 (rows) and frame k (columns). Every function takes O(N d^3) operations.
"""
# mypy: no-check-untyped-defs, allow-untyped-defs

import math

import numpy as np

from phd_exp.fusion.arithmetic import compiled


@compiled
def factorise(diagonal, coupling, below):
    """Replaces the lower triangles of `diagonal` by those of the Cholesky factor, and fills in its blocks `below`.

    The matrix is L L^T, where L has `diagonal` on the diagonal and `below` under it. NaN where the matrix is not
    positive definite.
    """
    _cholesky(diagonal[0])
    for k in range(1, len(diagonal)):
        _eliminate(diagonal[k - 1], coupling[k - 1], below[k - 1], diagonal[k])
        _cholesky(diagonal[k])


@compiled
def _cholesky(block):
    """Replaces the lower triangle of a block by that of its Cholesky factor."""
    for i in range(len(block)):
        for j in range(i + 1):
            rest = block[i, j]
            for m in range(j):
                rest -= block[i, m] * block[j, m]
            block[i, j] = math.sqrt(rest) if i == j else rest / block[j, j]


@compiled
def _eliminate(L, coupling, below, block):
    """Fills in the X with X L^T = coupling, and subtracts X X^T from the lower triangle of the next block."""
    d = len(L)
    for i in range(d):
        for j in range(d):
            rest = coupling[i, j]
            for m in range(j):
                rest -= below[i, m] * L[j, m]
            below[i, j] = rest / L[j, j]
        for j in range(i + 1):
            product = 0.0
            for m in range(d):
                product += below[i, m] * below[j, m]
            block[i, j] -= product


@compiled
def forward(L, below, b):
    """Replaces b (N x d) by the x with L x = b."""
    frames, d = b.shape
    for k in range(frames):
        for i in range(d):
            rest = b[k, i]
            if k > 0:
                for m in range(d):
                    rest -= below[k - 1, i, m] * b[k - 1, m]
            for m in range(i):
                rest -= L[k, i, m] * b[k, m]
            b[k, i] = rest / L[k, i, i]


@compiled
def backward(L, below, b):
    """Replaces b (N x d) by the x with L^T x = b."""
    frames, d = b.shape
    for k in range(frames - 1, -1, -1):
        for i in range(d - 1, -1, -1):
            rest = b[k, i]
            if k < frames - 1:
                for m in range(d):
                    rest -= below[k, m, i] * b[k + 1, m]
            for m in range(i + 1, d):
                rest -= L[k, m, i] * b[k, m]
            b[k, i] = rest / L[k, i, i]


@compiled
def solve(L, below, b):
    """Replaces b (N x d) by the solution of the system."""
    forward(L, below, b)
    backward(L, below, b)


@compiled
def inverse_of_factor(L, inverse):
    """Fills `inverse` with that of a lower triangle (d x d)."""
    d = len(L)
    inverse[:] = 0.0
    for j in range(d):
        inverse[j, j] = 1 / L[j, j]
        for i in range(j + 1, d):
            rest = 0.0
            for m in range(j, i):
                rest -= L[i, m] * inverse[m, j]
            inverse[i, j] = rest / L[i, i]


@compiled
def selected_inverse(L, below, covariance):
    """Fills `covariance` with the diagonal blocks of the inverse matrix.

    From the last frame back, C_k = (L_k L_k^T)^(-1) + G^T C_(k+1) G with G = below_k L_k^(-1).

    Source: Takahashi, Fagan and Chin, "Formation of a sparse bus impedance matrix" (1973); the recursion of Rauch,
    Tung and Striebel in the form of a factor.
    """
    frames, d = covariance.shape[0], covariance.shape[1]
    inverse, G, product = np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    for k in range(frames - 1, -1, -1):
        inverse_of_factor(L[k], inverse)
        if k < frames - 1:
            _multiply(below[k], inverse, G)
            _multiply(covariance[k + 1], G, product)
        for i in range(d):
            for j in range(i + 1):
                value = 0.0
                for m in range(i, d):  # below the diagonal of the factor alone
                    value += inverse[m, i] * inverse[m, j]
                if k < frames - 1:
                    for m in range(d):
                        value += G[m, i] * product[m, j]
                covariance[k, i, j] = covariance[k, j, i] = value


@compiled
def _multiply(A, B, product):
    """Fills in A B."""
    d = len(A)
    for i in range(d):
        for j in range(d):
            value = 0.0
            for m in range(d):
                value += A[i, m] * B[m, j]
            product[i, j] = value


@compiled
def log_determinant(L):
    """The logarithm of the determinant, from the factor."""
    value = 0.0
    for k in range(L.shape[0]):
        for i in range(L.shape[1]):
            value += 2 * math.log(L[k, i, i])
    return value
