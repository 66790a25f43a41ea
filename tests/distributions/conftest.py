"""Every Projected Huber density of the list, for tests of its own functions."""

import pytest

from phd_exp.distributions import ProjectedHuber
from tests.support.densities import INSTANCES


@pytest.fixture(scope="session", params=INSTANCES.values(), ids=INSTANCES.keys())
def distribution(request: pytest.FixtureRequest) -> ProjectedHuber:
    return request.param
