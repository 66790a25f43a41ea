"""Shares of a data set, so that several processes render one folder without speaking to each other."""

import re
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Shard:
    """The samples of every split whose index is `index` modulo `count`: shares of equal cost."""

    index: int
    count: int

    def __post_init__(self) -> None:
        if not 0 <= self.index < self.count:
            raise ValueError(_expected(self.count))

    @classmethod
    def parse(cls, text: Any) -> "Shard":
        """What a user writes: `0/4`. Raises ValueError, with what was expected, for anything else."""
        match = re.fullmatch(r"(\d+)/(\d+)", text) if isinstance(text, str) else None
        if match is None:
            raise ValueError(_expected(4))
        return cls(int(match[1]), int(match[2]))

    def __str__(self) -> str:
        return f"{self.index}/{self.count}"

    @property
    def slug(self) -> str:
        """The same as part of a file's name."""
        return f"{self.index}-of-{self.count}"

    def holds(self, index: int) -> bool:
        """Whether the sample with this index is of this share."""
        return index % self.count == self.index


def _expected(count: int) -> str:
    examples = f"from 0/{count} to {count - 1}/{count}" if count else "such as 0/4"
    return f"expected INDEX/COUNT with 0 <= INDEX < COUNT, {examples}"
