"""The interface of densities: what it enforces, and its defaults against the closed forms."""

from operator import attrgetter

import pytest
import torch

from phd_exp.distributions import Density, PointEstimate, ProjectedHuber
from phd_exp.distributions.shaped import Shaped

MEMBERS = (*sorted(Density.__abstractmethods__), "depth_icdf")


def own(members: tuple[str, ...]) -> type[Density]:
    """A density that has these members alone, all of the Projected Huber density `of`."""
    forwarded = {name: property(attrgetter(f"of.{name}")) for name in members}
    return type("Own", (Density,), forwarded | {"__init__": lambda self, of: setattr(self, "of", of)})


@pytest.mark.parametrize("name", sorted(Density.__abstractmethods__))
def test_a_density_without_one_of_its_members_is_refused(name: str, distribution: ProjectedHuber) -> None:
    with pytest.raises(TypeError, match=name):
        own(tuple(member for member in MEMBERS if member != name))(distribution)


def test_defaults_are_near_the_closed_forms(distribution: ProjectedHuber) -> None:
    ours, z = own(MEMBERS)(distribution), distribution.depth_icdf(torch.tensor([0.1, 0.4, 0.9], dtype=torch.float64))
    of_ray = ("mean",) if distribution.k is None else ()  # the default is for an axis through the camera
    for name in (*of_ray, "depth_mean", "depth_variance", "depth_median"):
        torch.testing.assert_close(getattr(ours, name), getattr(distribution, name), rtol=5e-3, atol=1e-9)
    torch.testing.assert_close(ours.depth_crps(z), distribution.depth_crps(z), rtol=2e-3, atol=1e-9)
    torch.testing.assert_close(ours.covariance_matrix[..., 2, 2], ours.depth_variance, rtol=1e-12, atol=0)


def test_one_density_has_closed_forms_and_points_have_no_covariance() -> None:
    kinds = (ProjectedHuber, Shaped, own(MEMBERS), PointEstimate)
    assert [kind.has_closed_forms for kind in kinds] == [True, False, False, False]
    assert [kind.has_covariance for kind in kinds] == [True, True, True, False]
