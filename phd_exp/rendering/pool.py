"""The parent's side of the worker processes: start them, hand out samples, notice deaths."""

import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Generator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType

from pydantic import ValidationError

from phd_exp.records.dataset import DatasetFolder
from phd_exp.records.errors import RenderError
from phd_exp.records.scenes import SampleRecord
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.worker import Answer, Job, Task

PATIENCE = 10.0  # s that a worker gets to finish its sample before it is ended


class Worker:
    """One worker process; used as a context, it is gone at the end.

    Args:
        job: the data set it renders.
        log: where what Blender prints goes.
    """

    def __init__(self, job: Job, log: Path) -> None:
        self._log = log
        with open(log, "ab") as stream:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "phd_exp.rendering.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=stream,
                env=_worker_environment(),
                text=True,
                encoding="utf-8",
            )
        self._send(job.model_dump_json())

    def __enter__(self) -> "Worker":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The end of its input ends a worker, once it has finished the sample in hand."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def render(self, task: Task) -> SampleRecord:
        """Have one sample rendered and wait for its record.

        Raises:
            RenderError: the worker says so, or has died.
        """
        assert self._process.stdout is not None
        self._send(task.model_dump_json())
        line = self._process.stdout.readline()
        try:
            answer = Answer.model_validate_json(line)
        except ValidationError:
            raise RenderError(self._obituary()) from None
        if answer.record is None:
            raise RenderError(answer.error or "a render worker gave an empty answer")
        return answer.record

    def _send(self, line: str) -> None:
        assert self._process.stdin is not None
        # A dead worker is noticed where its answer is missing, and reported once, there.
        with suppress(BrokenPipeError):
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()

    def _obituary(self) -> str:
        try:
            code = self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            return f"a render worker (process {self._process.pid}) gave a senseless answer; see {self._log}"
        how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with status {code}"
        return (
            f"a render worker (process {self._process.pid}) {how}; finished images are kept, and the same "
            f"command goes on from there (its last words: {self._log})"
        )


def render_all(
    folder: DatasetFolder, spec: DatasetSpec, tasks: Sequence[Task], workers: int
) -> Generator[SampleRecord, None, None]:
    """Render samples with several processes and yield each record as soon as its image is on disk.

    At most one sample a worker is in flight: it gets the next when the consumer has dealt with the last, so that a
    kill loses no more. When the consumer stops early or a worker fails, no further sample is begun, those in flight
    are finished, and all processes have ended before the error goes on.

    Raises:
        RenderError: a worker failed or died.
    """
    idle: queue.SimpleQueue[Worker | None] = queue.SimpleQueue()  # None: there will be no more work
    stopping = threading.Event()

    def on_an_idle_worker(task: Task) -> tuple[Worker, SampleRecord]:
        worker = idle.get()
        try:
            if worker is None or stopping.is_set():
                raise CancelledError
            return worker, worker.render(task)
        except BaseException:
            idle.put(worker)  # for the next thread that waits
            raise

    with ExitStack() as stack:
        job, log = Job(root=folder.root, spec=spec), folder.cache / "render.log"
        for _ in range(workers):
            idle.put(stack.enter_context(Worker(job, log)))
        threads = stack.enter_context(ThreadPoolExecutor(workers))
        futures = [threads.submit(on_an_idle_worker, task) for task in tasks]
        try:
            for future in as_completed(futures):
                worker, record = future.result()
                yield record
                idle.put(worker)
        finally:
            stopping.set()
            idle.put(None)
            threads.shutdown(wait=False, cancel_futures=True)


def _worker_environment() -> dict[str, str]:
    """The caller's environment, with this package importable and one thread a process."""
    package_home = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(filter(None, [package_home, os.environ.get("PYTHONPATH")]))
    return os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
