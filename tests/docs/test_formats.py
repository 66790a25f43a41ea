"""The guides list every format that is read."""

import re
from collections.abc import Iterable
from pathlib import Path

import pytest

from phd_exp.records.assets import MESHES, PHOTOS, SKIES
from phd_exp.records.cameras import COEFFICIENTS
from phd_exp.records.foreign import COCO_FILES
from phd_exp.records.images import FORMATS
from tests.docs.pages import DOCS
from tests.records.test_cameras import SAME

TOOLS = {re.sub(r"^JSON of |,.*| \d$", "", name) for name in SAME}  # which the tests of camera files read


@pytest.mark.parametrize(
    ("guide", "names"),
    [
        ("own_object", [suffix[1:].upper() for suffix in MESHES if suffix != ".gltf"]),
        ("own_object", [*SKIES, "glTF", *{"JPEG" if "jp" in suffix else suffix[1:] for suffix in PHOTOS}]),
        ("own_images", FORMATS),
        ("own_images", {Path(name).name.replace("{}", "train") for name in COCO_FILES}),
        ("own_images", [*TOOLS, *COEFFICIENTS]),
    ],
)
def test_a_guide_names_all_that_is_read(guide: str, names: Iterable[str]) -> None:
    text = (DOCS / "guides" / f"{guide}.md").read_text().lower()
    assert [name for name in names if not re.search(rf"(?<!\w){re.escape(name.lower())}(?!\w)", text)] == []
