"""A sweep in one process: `python sweeper.py ARGUMENT...` prints, for each job, its seconds beside those of `fit`."""

import json
import sys
import time
from typing import Any

from lightning import Trainer

from phd_exp.cli import train


class Stopwatch:
    """A function, and how long it took in all since the last reset."""

    def __init__(self, function: Any) -> None:
        self.function = function
        self.seconds = 0.0

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        start = time.perf_counter()
        try:
            return self.function(*arguments, **named)
        finally:
            self.seconds += time.perf_counter() - start


def main(arguments: list[str]) -> int:
    fit, task = Stopwatch(Trainer.fit), train.task
    Trainer.fit = lambda *words, **named: fit(*words, **named)  # type: ignore[method-assign]

    def timed(config: dict[str, Any], overrides: list[str], cores: int) -> str:
        fit.seconds, whole = 0.0, Stopwatch(task)
        ended: str = whole(config, overrides, cores)
        print(json.dumps({"job": whole.seconds, "training": fit.seconds}), flush=True)
        return ended

    train.task = timed
    return train.main(["-m", *arguments])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
