"""The worker process: tasks come on standard input, answers go to standard output, one JSON line each.

`python -m phd_exp.rendering.worker` is a process of its own rather than a `multiprocessing` child: it
imports neither the caller's main module nor torch, it works the same from a script, a notebook and a test,
and it ends by itself when its parent is gone, because its input then ends.
"""

import os
import signal
import sys
import traceback
from pathlib import Path
from typing import TextIO

import numpy as np
from pydantic import BaseModel

from phd_exp.records.dataset import DatasetFolder, image_name, sha256
from phd_exp.records.errors import UserError, unwritable
from phd_exp.records.files import write_atomic
from phd_exp.records.scenes import SampleRecord, Scene, Split
from phd_exp.records.spec import DatasetSpec
from phd_exp.rendering.blender import Renderer, Settings
from phd_exp.rendering.compose import take_picture
from phd_exp.rendering.pixels import encode
from phd_exp.rendering.rays import Hits, in_camera_frame, trace_pixels, truncation, visibility
from phd_exp.rendering.sampling import sample_scene, scene_and_view


class Job(BaseModel):
    """The first line a worker reads: which data set, and where."""

    root: Path
    spec: DatasetSpec


class Task(BaseModel):
    """Each further line: one sample to render."""

    split: Split
    index: int


class Answer(BaseModel):
    """What a worker says to a task: the record of the finished image, or why there is none."""

    record: SampleRecord | None = None
    error: str | None = None


def fast_settings(spec: DatasetSpec) -> Settings:
    """How the tracer is run for a data set's pictures."""
    return Settings(samples=spec.samples_per_pixel, denoised=True, at_middles=True)


def render_sample(
    renderer: Renderer, folder: DatasetFolder, spec: DatasetSpec, split: Split, index: int
) -> SampleRecord:
    """Render one sample, write its image, and return its record.

    Raises:
        OSError: the image cannot be written.
    """
    image, record = make_sample(renderer, spec, split, index)
    write_atomic(folder.image_path(split, index, spec.image_format), image)
    return record


def make_sample(
    renderer: Renderer, spec: DatasetSpec, split: Split, index: int
) -> tuple[bytes, SampleRecord]:
    """The image file and the record of one sample."""
    scene = sample_scene(spec, split, index)
    hits = trace_pixels(scene)
    image = encode(take_picture(renderer, scene, hits), spec)
    return image, describe(spec, split, index, scene, hits, sha256(image))


def describe(
    spec: DatasetSpec, split: Split, index: int, scene: Scene, hits: Hits, checksum: str
) -> SampleRecord:
    """The record of a sample whose image has a checksum, and whose pixels' rays have been traced."""
    number, view = scene_and_view(spec, index)
    cylinder = scene.objects[0]
    x, y, z = in_camera_frame(np.array(cylinder.position), scene.pose).tolist()
    return SampleRecord(
        file_name=image_name(index, spec.image_format),
        x=x,
        y=y,
        z=z,
        f=scene.f,
        S=scene.S,
        scale=cylinder.scale,
        visibility=visibility(hits),
        truncation=truncation(scene, hits),
        index=index,
        split=split,
        seed=spec.seed,
        scene=number,
        view=view,
        pose=scene.pose,
        objects=scene.objects,
        lamps=scene.lamps,
        backdrop=scene.backdrop,
        noise_seed=scene.noise_seed,
        sha256=checksum,
    )


def serve(tasks: TextIO, answers: TextIO) -> None:
    """Answer tasks until they end; the renderer is built for the first, so that its errors are answers."""
    job = Job.model_validate_json(tasks.readline())
    folder = DatasetFolder(job.root)
    renderer: Renderer | None = None
    for line in tasks:
        task = Task.model_validate_json(line)
        try:
            renderer = renderer or Renderer(fast_settings(job.spec))
            answer = Answer(record=render_sample(renderer, folder, job.spec, task.split, task.index))
        except UserError as error:
            answer = Answer(error=str(error))
        except OSError as error:
            answer = Answer(error=str(unwritable(error, job.root)))
        except Exception as error:
            traceback.print_exc()
            answer = Answer(error=f"sample {task.index} of {task.split}: {type(error).__name__}: {error}")
        answers.write(answer.model_dump_json(exclude_none=True) + "\n")


def main() -> None:
    """Serve the process's own standard streams."""
    # Ctrl-C reaches the whole group of processes; the parent alone decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Blender's C code prints to file descriptor 1: that becomes the log, the answers keep their own channel.
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    try:
        serve(sys.stdin, answers)
    except BrokenPipeError:
        # The parent has gone. What is left unsaid goes nowhere, or closing the channel would fail once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), answers.fileno())


if __name__ == "__main__":
    main()
