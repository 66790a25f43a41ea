"""Explains a wrong word of Hydra's command line in one line, with the nearest valid word."""

import re
import shlex
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence

import hydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from phd_exp.cli import choices_of, conf_folder, prefix_of
from phd_exp.cli.help import OF_VERB, VERBS
from phd_exp.records.choices import flatten
from phd_exp.records.errors import ConfigError, install, one_line, shortened, unknown

REFUSED = (HydraException, OmegaConfBaseException, ValueError, TypeError, ArithmeticError, RecursionError)
"""The errors that a bad override raises; ValueError for a group set to null, TypeError for one set to numbers."""
SHARED = ("network", "object")
"""Sections in which presets and recipes describe networks and data=object; a run has the values themselves."""
LONGEST = 400  # characters of Hydra's messages that are repeated
GRAMMAR = "expected KEY=VALUE without spaces, or with the value in quotes, \"KEY='VALUE'\""


def require_overrides(words: Sequence[str]) -> None:
    """Raise ConfigError for the first word that is no override of Hydra's grammar."""
    for parts in _rejoined(words):
        word = "".join(parts)
        if len(parts) > 1:
            raise ConfigError(f"{' '.join(parts)}: has spaces; expected {shlex.quote(word)}")
        if re.search("[\ud800-\udfff]", word):
            raise ConfigError(f"{word}: is not UTF-8, as the record of a run is; rename the file or folder")
        if "=" not in word and not word.startswith("~"):
            choices = [f"{group}={name}" for group in OF_VERB["train"] for name in choices_of(group)]
            expected = f"a verb ({', '.join(VERBS)}) is the first word; {GRAMMAR}"
            raise ConfigError(unknown(word, [*VERBS, *choices], expected, fault="no KEY=VALUE"))
        if word.lstrip("+~").startswith(tuple(f"{section}." for section in SHARED)):
            key = word.partition("=")[0]
            raise ConfigError(
                f"{key}: set by presets and recipes; expected the key of the run, such as backbone.width"
            )
        try:
            OverridesParser.create().parse_override(word)
        except REFUSED as error:
            reason = re.sub(r" *See https.*", "", one_line(str(error)))
            raise ConfigError(f"{shortened(word)}: {shortened(reason)}; {GRAMMAR}") from None


def _rejoined(words: Sequence[str]) -> Iterator[list[str]]:
    """The parts of each word that a shell has split at spaces about `=`, after commas and inside brackets."""
    parts: list[str] = []
    for word in words:
        before = "".join(parts)
        is_open = before.endswith(("=", ",")) or any(before.count(a) > before.count(b) for a, b in ("[]", "{}", "()"))
        if parts and (word.startswith("=") or (is_open and "=" not in word)):
            parts.append(word)
            continue
        if parts:
            yield parts
        parts = [word]
    if parts:
        yield parts


def explain(error: Exception, config_name: str) -> str:
    """An error of Hydra as one line: the override, why it is invalid, and the nearest valid one."""
    text = " ".join(str(error).split())
    if found := re.search(r"Could not override '([^']+)'", text):
        return _unknown_key(found[1].lstrip("+~"), config_name)
    if found := re.search(r"Could not (?:find|load) '([^']+)/([^']+)'", text):
        group, name = found.groups()
        options = getattr(error, "options", None) or choices_of(group)
        return unknown(f"{group}={name}", options, fault="no such choice") + install(name)
    return shortened(re.sub(r" Set the environment variable.*| Config search path:.*", "", text), LONGEST)


def _unknown_key(key: str, config_name: str) -> str:
    keys = _keys_of_choices()
    if owners := keys.get(key):
        return f"{key}: not a key of this choice, but of {' or '.join(owners)}; name that choice too"
    groups = OF_VERB["render" if config_name == "render" else "train"]
    if key in groups:
        return f"{key}: a group; expected {key}=CHOICE, or {key}.KEY=VALUE"
    is_hydra, launcher = key.startswith("hydra."), [word for word in sys.argv if word.startswith("hydra/")]
    with hydra.initialize_config_dir(str(conf_folder()), version_base="1.3"):
        composed = hydra.compose(config_name, launcher * is_hydra, return_hydra_config=is_hydra)
        names = ["hydra"] if is_hydra else [str(name) for name in composed if name not in SHARED]
        config = OmegaConf.masked_copy(composed, names)
    top = sorted({*map(str, config), *groups})
    everything = [*flatten(OmegaConf.to_container(config))]  # type: ignore[arg-type]
    everything += [] if is_hydra else [*top, *keys]
    section = key.rpartition(".")[0]
    node = OmegaConf.select(config, section) if section else None
    if not isinstance(node, DictConfig):
        return unknown(key, everything, f"expected one of {', '.join(top)}")
    valid = [str(name) for name in node if not str(name).startswith("_")]
    near = [*(f"{section}.{name}" for name in valid), *everything]
    takes_more = not is_hydra and (section == "trainer" or "_target_" in node)
    further = f"; a further argument of its class has a plus sign: +{key}=VALUE" if takes_more else ""
    one = f"one of {', '.join(valid)}" if valid else f"a choice with keys: {section.replace('.', '/')}=CHOICE"
    return unknown(key, near, f"expected {one}{further}")


def _keys_of_choices() -> dict[str, list[str]]:
    """Dotted key -> the choices whose files set it; backbone=resnet has the keys of a recipe's `network.resnet`."""
    owners: dict[str, list[str]] = defaultdict(list)
    for group in OF_VERB["train"]:
        for name in choices_of(group):
            file = conf_folder() / group / f"{name}.yaml"
            prefix = prefix_of(group, file.read_text())
            for key in flatten(OmegaConf.to_container(OmegaConf.load(file)), prefix):  # type: ignore[arg-type]
                if key.startswith(f"{group}."):
                    owners[key].append(f"{group}={name}")
                elif key.startswith("network.resnet."):
                    owners[key.replace("network.resnet", "backbone")].append(f"{group}={name} backbone=resnet")
    return owners
