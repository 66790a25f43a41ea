"""`python -m phd_exp.rendering.worker FD`: a process that receives samples to render and returns their records."""

import traceback
from contextlib import suppress
from multiprocessing.connection import Connection

from phd_exp.records.errors import RenderError, UserError, unwritable
from phd_exp.records.processes import parent
from phd_exp.records.scenes import SampleRecord
from phd_exp.rendering.blender import Renderer
from phd_exp.rendering.samples import fast_settings, render_sample


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
            renderer = renderer or Renderer(fast_settings(spec))
            answer = render_sample(renderer, folder, spec, split, index)
        except UserError as error:
            answer = error
        except OSError as error:
            answer = unwritable(error, folder.root)
        except Exception as error:
            traceback.print_exc()
            answer = RenderError(f"sample {index} of {split}: {type(error).__name__}: {error}")
        connection.send(answer)


if __name__ == "__main__":
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        serve(parent())
