"""JSON and YAML from files that a stranger may have written: ambiguous content is refused."""

import json
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict

MOST_DIGITS = 300  # digits of an integer; a float holds 308


class Record(BaseModel):
    """Base class of records and configurations: immutable; an unknown or missing key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def parse_json(text: str) -> Any:
    """The content of a JSON text.

    Raises ValueError for invalid JSON, a key given twice in one object (of which Python keeps the last), too deep
    nesting, and an integer beyond the range of floating point.
    """
    try:
        return json.loads(text, object_pairs_hook=_once, parse_int=_whole)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def parse_yaml(text: str) -> Any:
    """The content of a YAML text: plain containers and values, never objects.

    Raises ValueError for invalid YAML, a key given twice, too deep nesting, an integer beyond the range of floating
    point, and an alias (`*name`): a few aliases can expand to gigabytes, and this project writes none.
    """
    try:
        return yaml.load(text, _PlainLoader)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(str(error)) from None
    except Exception as error:  # PyYAML raises any for a value that does not fit its tag, as `!!bool x`
        raise ValueError(f"a value does not fit its tag ({type(error).__name__}: {error})") from None


class _PlainLoader(yaml.SafeLoader):
    """PyYAML's safe loader without aliases and repeated keys."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise ValueError(f"the alias *{self.peek_event().anchor} stands for another part; write it out")
        return super().compose_node(parent, index)

    def construct_yaml_int(self, node: Any) -> int:
        value = int(super().construct_yaml_int(node))
        if abs(value) >= 10**MOST_DIGITS:  # in any base
            raise ValueError(f"a whole number of more than {MOST_DIGITS} digits")
        return value

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        _once([(key, None) for key in keys])
        return super().construct_mapping(node, deep)


_PlainLoader.add_constructor("tag:yaml.org,2002:int", _PlainLoader.construct_yaml_int)


def _whole(digits: str) -> int:
    if len(digits) > MOST_DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} is given twice")
    return content
