"""The two columns of the paper's tables: error along the true viewing ray, and across it."""

from jaxtyping import Float
from torch import Tensor

MILLIMETRES = 1000.0


def along_true_ray(
    xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """The true position moved along its own viewing ray to where the estimate projects onto that ray.

    v_par = (v . v^ / |v|^2) v, in metres.
    """
    scale = (xyz * estimate).sum(-1, keepdim=True) / xyz.square().sum(-1, keepdim=True)
    return scale * xyz


def projected_error(
    xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """|v^ - v_par|: the distance of the estimate from the true viewing ray, in metres."""
    return (estimate - along_true_ray(xyz, estimate)).norm(dim=-1)


def depth_error(
    xyz: Float[Tensor, "*batch 3"], estimate: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """| |v_par| - |v| |: the error along the true viewing ray, in metres."""
    return (along_true_ray(xyz, estimate).norm(dim=-1) - xyz.norm(dim=-1)).abs()
