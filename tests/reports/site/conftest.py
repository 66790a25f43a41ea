"""One site for all tests, and a browser page that records every fault."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.browser import Visit
from tests.support.recorded import once, reported
from tests.support.site_runs import write_runs


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `runs/`, `renders/` and `out/site/`; no test changes it."""
    return once(tmp_path_factory, "shared_site", lambda folder: reported(write_runs(folder), folder / "out"))


@pytest.fixture(scope="session")
def site(shared: Path) -> Path:
    return shared / "out" / "site"


@pytest.fixture
def visit(chromium: Any, site: Path, request: pytest.FixtureRequest) -> Iterator[Visit]:
    options = getattr(request, "param", {"viewport": {"width": 1280, "height": 800}})
    visited = Visit(chromium, site, **options)
    yield visited
    visited.context.close()
    assert visited.faults == []
