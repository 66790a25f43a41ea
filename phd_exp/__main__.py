"""`python -m phd_exp [verb] [group=choice ...] [key=value ...]`; imports the verb only after reading its name."""

import os
import re
import sys
from importlib import import_module

from phd_exp import __version__
from phd_exp.cli.help import OF_VERB, VERBS, text_of

HELP = {"-h", "--help", "help"}
COMPLETION = {"-sc", "--shell-completion"}
TYPED = "COMP_LINE"  # the variable with the line that a shell wants completed
NOBODY_READS = 128 + 13  # the exit status that a shell reports for a programme ended by SIGPIPE


def main(arguments: list[str] | None = None) -> int:
    """Run the verb that the arguments name; returns the exit status."""
    status = 0
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115 - closed; print() would take standard output
    try:
        status = _run(list(sys.argv[1:] if arguments is None else arguments))
        print(end="", flush=True)
        return status
    except BrokenPipeError:  # `| head`
        status = NOBODY_READS
    except OSError as error:
        if not status:
            print(f"error: standard output: {error.strerror}", file=sys.stderr)
        status = 1
    # otherwise Python prints an error when it flushes at exit
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return status


def _run(words: list[str]) -> int:
    verb = _take_verb(words)
    if COMPLETION & set(words):
        verb = _take_verb_from_line()
        if verb and verb not in OF_VERB:  # Hydra completes, and this verb has no groups
            return 0
    if HELP & set(words) or "--version" in words:
        print(text_of(verb) if HELP & set(words) else f"phd_exp {__version__}")
        return 0
    if verb == "report":  # small arrays: several threads of BLAS, which NumPy starts at its import, would wait
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from phd_exp.cli.frame import run_verb

    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for the user's own parts, as with `python -m`
    return run_verb(lambda rest: import_module(f"phd_exp.cli.{verb or 'train'}").main(rest), words)


def _take_verb(words: list[str]) -> str | None:
    """Remove the verb from the words and return it. It is the first word, or follows -m."""
    place = 1 if words[:1] in (["-m"], ["--multirun"]) else 0
    return words.pop(place) if words[place : place + 1] and words[place] in VERBS else None


def _take_verb_from_line() -> str | None:
    """Remove the verb from the line to complete, because Hydra knows no verbs, and return it."""
    line = os.environ.get(TYPED, "")
    found = re.match(rf"(\S+(?: -m| --multirun)?) ({'|'.join(VERBS)})(?= )", line)
    if found is None:
        return None
    os.environ[TYPED] = found[1] + line[found.end() :]
    return found[2]


if __name__ == "__main__":
    sys.exit(main())
