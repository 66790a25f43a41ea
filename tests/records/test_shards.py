"""Shares of a data set: every sample is in one of them, and they are of one size."""

import pytest

from phd_exp.records.spec import Shard


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_shares_are_a_partition_of_equal_sizes(count: int) -> None:
    shards = [Shard.parse(f"{index}/{count}") for index in range(count)]
    sizes = [sum(shard.holds(index) for index in range(20)) for shard in shards]
    assert max(sizes) - min(sizes) <= 1
    for index in range(20):
        assert sum(shard.holds(index) for shard in shards) == 1


@pytest.mark.parametrize("text", ["0/4", "3/4", "10/12"])
def test_a_shard_is_written_as_it_is_read(text: str) -> None:
    assert str(Shard.parse(text)) == text


@pytest.mark.parametrize("text", ["4/4", "-1/2", "1/0", "0/0", "a", "1", "", "1/2/3", " 1/2", 1, 0.5, None])
def test_what_is_no_shard_is_refused(text: object) -> None:
    with pytest.raises(ValueError, match="expected INDEX/COUNT with 0 <= INDEX < COUNT"):
        Shard.parse(text)
