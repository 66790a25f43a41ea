"""YAML of a stranger: plain values or one ValueError, whatever a tag, a number or an escape does to the parser."""

import pytest

from phd_exp.records.parsing import parse_yaml

REFUSED = [
    "a: !!bool x", "a: !!int ''", "a: !!float ''", "a: !!timestamp x", "a: !!timestamp [1]", "a: !!map [a]",
    "!!map [a]", "a: !!set [x]", "a: !!omap {a: b}", "a: !!pairs x", "a: !!str [a]", "a: !!seq {}",
    'a: "\\UFFFFFFFF"', "a: 2001-99-99", "a: 0x" + "f" * 5000, "a: 0b" + "1" * 9000, "a: " + "9" * 5000,
    "a: 1" + ":59" * 3000, "a: -0x" + "f" * 300, "? [a]\n: b", "<<: 3", "a: !!python/object/apply:os.system [x]",
    "a: [", "a: \x00", "a: &a [*a]", "a: 1\na: 2",
]  # fmt: skip


@pytest.mark.parametrize("text", REFUSED, ids=lambda text: text[:30])
def test_any_fault_of_the_parser_is_a_value_error(text: str) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        parse_yaml(text)


def test_plain_values_come_through() -> None:
    text = "a: 0x10\nb: -7\nc: 1.5\nd: yes\ne: [x, null]\nf: 'on'"
    assert parse_yaml(text) == {"a": 16, "b": -7, "c": 1.5, "d": True, "e": ["x", None], "f": "on"}
