"""Every sample is in exactly one stratum, which has a descriptive label."""

import math

import pytest
import torch

from phd_exp.metrics.strata import strata

VALUES = {
    "spread": torch.rand(500, generator=torch.Generator().manual_seed(0), dtype=torch.float64),
    "with NaN": torch.tensor([0.1, math.nan, 0.7, 0.3, math.nan]),
    "many equal": torch.tensor([1.0] * 90 + [0.2, 0.5, 0.7] * 3),
    "all equal": torch.full((7,), 0.5),
    "all NaN": torch.full((3,), math.nan),
    "on the edges": torch.tensor([0.0, 0.25, 0.5, 1.0]),
    "beyond the edges": torch.tensor([-1.0, 0.3, 2.0]),
    "none": torch.zeros(0),
}


@pytest.mark.parametrize("edges", [1, 4, (0.0, 0.25, 0.5, 1.0), (0.5,)], ids=str)
@pytest.mark.parametrize("name", VALUES)
def test_every_sample_is_in_exactly_one(name: str, edges: int | tuple[float, ...]) -> None:
    found = strata("x", VALUES[name], edges)
    masks = torch.stack([torch.zeros(len(VALUES[name]), dtype=torch.bool), *found.values()])
    assert (masks.sum(0) == 1).all()
    assert all(mask.any() for mask in found.values())


def test_labels_say_name_edges_and_unit() -> None:
    depth = torch.linspace(3, 5, 401)
    assert list(strata("depth", depth, 4, "m")) == [
        "depth 3.0-3.5 m",
        "depth 3.5-4.0 m",
        "depth 4.0-4.5 m",
        "depth 4.5-5.0 m",
    ]
    visibility = torch.tensor([0.1, 0.25, 0.5, 1.0, math.nan])
    assert list(strata("visibility", visibility, (0.0, 0.25, 0.5, 0.9))) == [
        "visibility 0-0.25",
        "visibility 0.25-0.5",
        "visibility 0.5-0.9",
        "visibility above 0.9",
        "visibility unknown",
    ]


def test_parts_are_of_equal_size_and_include_their_lower_edge() -> None:
    assert [int(mask.sum()) for mask in strata("x", VALUES["spread"], 4).values()] == [125, 125, 125, 125]
    masks = [mask.int().tolist() for mask in strata("x", VALUES["on the edges"], (0.0, 0.25, 0.5, 1.0)).values()]
    assert masks == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]]
