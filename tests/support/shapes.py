"""Checks of shapes at run time whose cost does not grow with the length of a loop."""

from collections.abc import Callable
from typing import Any

from beartype import beartype

CALLS = 3  # of each function in each test
number = 0  # of the test that runs


def next_test() -> None:
    """Check the first calls of each function again."""
    global number
    number += 1


def first_calls(function: Callable[..., Any]) -> Callable[..., Any]:
    """A type checker for jaxtyping: that of beartype, for the first calls in each test.

    Checks of all calls took half of the time of the tests of numbers.
    """
    checked = beartype(function)
    test, left = number, CALLS

    def check(*args: Any, **kwargs: Any) -> Any:
        nonlocal test, left
        if test != number:
            test, left = number, CALLS
        if not left:
            return None
        left -= 1
        return checked(*args, **kwargs)

    return check
