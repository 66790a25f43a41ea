"""What a shell asks while a line is typed: `-sc query=SHELL`, with the line so far in the environment."""

import os
import re

LINE = "COMP_LINE"
FLAGS = ("-sc", "--shell-completion")


def take_verb_from_line(verbs: list[str]) -> str | None:
    """Remove the verb from the line that is to be completed, where Hydra would stumble over it, and return it."""
    line = os.environ.get(LINE, "")
    found = re.match(rf"(\S+(?: -m| --multirun)?) ({'|'.join(verbs)})(?= )", line)
    if found is None:
        return None
    os.environ[LINE] = found[1] + line[found.end() :]
    return found[2]
