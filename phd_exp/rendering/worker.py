"""`python -m phd_exp.rendering.worker FD`: a process that receives samples to render and returns their records."""

import traceback
from contextlib import nullcontext, suppress
from multiprocessing.connection import Connection

from phd_exp.records.errors import RenderError, UserError, writing
from phd_exp.records.files import write_atomic
from phd_exp.records.processes import one_core, parent
from phd_exp.records.scenes import SampleRecord
from phd_exp.rendering.blender import Renderer
from phd_exp.rendering.samples import fast_settings, make_sample


def serve(connection: Connection) -> None:
    """Receive a data set, then one sample after another; answer each with its record or a UserError.

    Raises EOFError or BrokenPipeError when the parent is gone.
    """
    folder, spec = connection.recv()
    renderer: Renderer | None = None  # built for the first sample, so that its errors are answers
    while True:
        split, index = connection.recv()
        answer: SampleRecord | UserError
        try:
            # Blender and its denoiser would start threads that take cores from the other workers
            with writing(folder.root), one_core() if renderer is None else nullcontext():
                renderer = renderer or Renderer(fast_settings(spec), spec)
                image, answer = make_sample(renderer, spec, split, index)
                write_atomic(folder.image_path(split, index, spec.image_format), image)
        except UserError as error:
            answer = error
        except Exception as error:
            traceback.print_exc()
            answer = RenderError(f"sample {index} of {split}: {type(error).__name__}: {error}")
        connection.send(answer)


if __name__ == "__main__":
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        serve(parent())
