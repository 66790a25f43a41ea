"""`python -m phd_exp [verb] [group=choice ...] [key=value ...]`; imports nothing heavy before it knows what to do."""

import os
import sys
from importlib import import_module

from phd_exp.cli.completion import FLAGS, take_verb_from_line
from phd_exp.cli.help import OF_VERB, VERBS, show

HELP = {"-h", "--help", "help"}


NOBODY_READS = 128 + 13
"""What a shell says of a programme that SIGPIPE ended."""


def main(arguments: list[str] | None = None) -> int:
    """Do what the arguments say, until it is done or nobody reads on (`| head`); returns the exit status."""
    try:
        status = _do(arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # Python flushes once more when it ends, and would complain
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return NOBODY_READS
    return status


def _do(arguments: list[str] | None) -> int:
    """Find the verb among the arguments and hand the rest to it."""
    rest = list(sys.argv[1:] if arguments is None else arguments)
    verb = _take_verb(rest)
    if set(FLAGS) & set(rest):
        verb = take_verb_from_line(list(VERBS))
        if verb and not OF_VERB[verb]:  # Hydra completes, and this verb takes no groups of it
            return 0
    if HELP & set(rest):
        return show(verb)
    if verb is not None and verb not in VERBS:
        print(f"error: no verb {verb!r}; expected one of {', '.join(VERBS)}, or key=value", file=sys.stderr)
        return 2
    module = import_module(f"phd_exp.cli.{verb or 'train'}")
    status: int = module.main(rest)
    return status


def _take_verb(words: list[str]) -> str | None:
    """Remove the verb from the words and return it; it comes first, or right after -m."""
    place = 1 if words[:1] in (["-m"], ["--multirun"]) else 0
    word = words[place] if place < len(words) else ""
    if not word or word in HELP or "=" in word or word.startswith(("-", "~", "+")):
        return None
    return words.pop(place)


if __name__ == "__main__":
    sys.exit(main())
