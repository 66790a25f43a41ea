"""The Projected Huber densities of the list, for tests of functions that only they have."""

import pytest

from phd_exp.distributions import ProjectedHuber
from tests.support.densities import INSTANCES


@pytest.fixture(scope="session", params=INSTANCES.values(), ids=INSTANCES.keys())
def distribution(request: pytest.FixtureRequest) -> ProjectedHuber:
    return request.param
