"""Raw numbers of networks on which computations in float32 are tried."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def hostile(n: int, generator: torch.Generator) -> Float[Tensor, "n 9"]:
    """Raw numbers at the ends of the range: modes at or beyond the edge of the field, long and thin densities, a from
    1e-4 to 1e6, depths a tenth and ten times those of the data.

    The eigenvalues of B are from 1e-5 to 1e4, and 1 to 10^4 apart, of which a head keeps 100. In every second row
    nu_p has the direction of the larger eigenvalue, where the digits of B^(-1) nu_p cancel.
    """

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(n, generator=generator, dtype=torch.float64)

    greater, turn, a, nu_z = 10 ** uniform(-1, 4), uniform(0, math.pi), 10 ** uniform(-4, 6), 10 ** uniform(-1, 1)
    lesser = greater / 10 ** uniform(0, 4).round()
    away = torch.where(torch.arange(n) % 2 == 0, 0, uniform(0, 2 * math.pi))
    reach = uniform(0.9, 1.5)
    c, s = turn.cos(), turn.sin()
    along, across = greater * reach * away.cos(), lesser * reach * away.sin()
    upper, lower, w_1 = (torch.where(phi < 1, phi.log(), phi - 1) for phi in (greater, lesser, a))
    w_2 = torch.where(nu_z > 1, a * (nu_z - 1), -a * (1 / nu_z - 1))
    b = (upper * c**2 + lower * s**2, math.sqrt(2) * (upper - lower) * c * s, upper * s**2 + lower * c**2)
    k = torch.randn(2, n, generator=generator, dtype=torch.float64)
    return torch.stack([along * c - across * s, along * s + across * c, *b, w_1, w_2, *k], dim=-1)
