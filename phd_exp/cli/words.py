"""Words of Hydra's command line: paths are quoted, and wrong words are explained with the nearest valid one."""

import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterable

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from phd_exp.cli import all_choices, choices_of, conf_folder, short_choices
from phd_exp.cli.help import OF_VERB, VERBS
from phd_exp.records.choices import flatten
from phd_exp.records.errors import ConfigError, install, one_line, shortened, unknown

REFUSED = (HydraException, OmegaConfBaseException, ValueError, TypeError, ArithmeticError, RecursionError)
"""The errors that a bad override raises; ValueError for a group set to null, TypeError for one set to numbers."""
SHARED = ("network", "object")
"""Sections in which presets and recipes describe networks and data=object; a run has the values themselves."""
PATHS = (
    *("runs", "init", "masks", "bop", "data.root", "data.folder", "data.mesh", "data.backdrops"),
    *("data.distractor_meshes", "data.camera"),
)
"""The keys whose values are paths."""
LONGEST = 400  # characters of Hydra's messages that are repeated
GRAMMAR = "expected KEY=VALUE without spaces, or with the value in quotes, \"KEY='VALUE'\""
_PARTS = re.compile(r"""\s*'(?:\\.|[^'\\])*'\s*(?=,|$)|\s*"(?:\\.|[^"\\])*"\s*(?=,|$)|[^,]+""")

for _group, _name, _node, _package in short_choices():
    ConfigStore.instance().store(group=_group, name=_name, node=_node, package=_package)


def in_conf() -> hydra.initialize_config_dir:
    """A context in which `hydra.compose` reads conf/."""
    return hydra.initialize_config_dir(str(conf_folder()), version_base="1.3")


def parsed(word: str) -> Override:
    """A word as an override of Hydra's grammar."""
    return OverridesParser.create().parse_override(word)


def overrides(words: Iterable[str], several: bool = False) -> list[str]:
    """The words with those paths in quotes that Hydra would read as something else.

    A path that exists is one value; otherwise commas separate the values of a list and, with `several`, of a sweep.
    What Hydra reads as one value stays as it is, because it is a part of the run's name. Raises ConfigError for the
    first word that is no override.

    Examples:
        >>> overrides(["runs=runs", "data.mesh=box(1).obj", "seed=1"])
        ['runs=runs', "data.mesh='box(1).obj'", 'seed=1']
        >>> overrides(["data.mesh=a.obj,b#2.obj"], several=True)
        ["data.mesh=a.obj,'b#2.obj'"]
    """
    found = [_quoted(word, several) for word in words]
    for word in found:
        _require_override(word)
    return found


def _quoted(word: str, several: bool) -> str:
    key, _, value = word.partition("=")
    if key.lstrip("+") not in PATHS or not value:
        return word
    value = os.path.expanduser(value) if value.startswith("~/") else value
    if not os.path.exists(value):
        read = _read(value)
        if read and (several or not getattr(read.value(), "simple_form", False)):
            return f"{key}={value}"
        if value.startswith("[") and value.endswith("]"):
            return f"{key}=[{','.join(map(_one_value, _PARTS.findall(value[1:-1])))}]"
        if several:
            return f"{key}={','.join(map(_one_value, _PARTS.findall(value)))}"
    return f"{key}={_one_value(value)}"


def _one_value(text: str) -> str:
    read = _read(text)
    if read and not (read.is_sweep_override() or isinstance(read.value(), list | dict)):
        return text
    return QuotedString(text, Quote.single).with_quotes()


def _read(value: str) -> Override | None:
    try:
        return parsed(f"path={value}")
    except HydraException:
        return None


def _require_override(word: str) -> None:
    key, is_assigned, _ = word.partition("=")
    if re.search("[\ud800-\udfff]", word):
        raise ConfigError(f"{word}: is not UTF-8, as the record of a run is; rename the file or folder")
    if not is_assigned and not word.startswith("~"):
        choices = [f"{group}={name}" for group in OF_VERB["train"] for name in choices_of(group)]
        expected = f"a verb ({', '.join(VERBS)}) is the first word; {GRAMMAR}"
        raise ConfigError(unknown(word, [*VERBS, *choices], expected, fault="no KEY=VALUE"))
    if key.lstrip("+~").startswith(tuple(f"{section}." for section in SHARED)):
        raise ConfigError(f"{key}: set by presets and recipes; expected the key of the run, such as backbone.width")
    try:
        parsed(word)
    except REFUSED as error:
        reason = re.sub(r" *See https.*", "", one_line(str(error)))
        raise ConfigError(f"{shortened(word)}: {shortened(reason)}; {GRAMMAR}") from None


def explain(error: Exception, config_name: str = "config") -> ConfigError:
    """An error of Hydra as one line: the override, why it is invalid, and the nearest valid one."""
    if isinstance(error, ConfigError):
        return error
    text = " ".join(str(error).split())
    if found := re.search(r"Could not override '[+~]*([^']+)'", text):
        return ConfigError(_unknown_key(found[1], config_name))
    if found := re.search(r"Could not (?:find|load) '([^']+)/([^']+)'", text):
        group, name = found.groups()
        options = getattr(error, "options", None) or choices_of(group)
        return ConfigError(unknown(f"{group}={name}", options, fault="no such choice") + install(name))
    return ConfigError(shortened(re.sub(r" Set the environment.*| Config search path:.*", "", text), LONGEST))


def _unknown_key(key: str, config_name: str) -> str:
    """The message about a key that the configuration lacks: a choice that has it, or the keys of its section."""
    if owners := (of_choices := _keys_of_choices()).get(key):
        return f"{key}: not a key of this choice, but of {' or '.join(owners)}; name that choice too"
    is_hydra, launcher = key.startswith("hydra."), [word for word in sys.argv if word.startswith("hydra/")]
    with in_conf():
        composed = hydra.compose(config_name, launcher * is_hydra, return_hydra_config=is_hydra)
    config = {str(name): composed[name] for name in composed if name not in SHARED}
    top = sorted({*config, *OF_VERB["render" if config_name == "render" else "train"]})
    if key in top:
        return f"{key}: a group; expected {key}=CHOICE, or {key}.KEY=VALUE"
    section = key.rpartition(".")[0]
    node = OmegaConf.select(composed, section) if section else None
    keys = list(map(str, node)) if isinstance(node, DictConfig) else []
    names = [name for name in keys if not name.startswith("_")]
    near = [*(f"{section}.{name}" for name in names), *flatten(OmegaConf.to_container(composed)), *top, *of_choices]  # type: ignore[arg-type]
    further = f"; a further argument of its class has a plus sign: +{key}=VALUE"
    takes_more = section == "trainer" or "_target_" in keys
    return unknown(key, near, f"expected one of {', '.join(names or top)}{further if takes_more else ''}")


def _keys_of_choices() -> dict[str, list[str]]:
    """Dotted key -> the choices that set it; backbone=resnet has the keys of a recipe's `network.resnet`."""
    owners: dict[str, list[str]] = defaultdict(list)
    for group in OF_VERB["train"]:
        for name, prefix, content in all_choices(group):
            for key in flatten(content, prefix):
                if key.startswith(f"{group}."):
                    owners[key].append(f"{group}={name}")
                elif key.startswith("network.resnet."):
                    owners[key.replace("network.resnet", "backbone")].append(f"{group}={name} backbone=resnet")
    return owners
