"""`python -m phd_exp fuse`: one position of each scene from several cameras, or from one camera and a known plane."""

import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import field_validator, model_validator

from phd_exp.cli.arguments import Beyond, Coverage, RunArguments, four_numbers, loaded, predicted
from phd_exp.cli.outputs import message_file, new_view, output_folder, require_output
from phd_exp.records.detections import NumberOrName
from phd_exp.records.errors import ConfigError, RunError, listed
from phd_exp.records.files import write_atomic
from phd_exp.records.messages import MessageFile
from phd_exp.records.own_images import Observed, annotations, detections_in, observed
from phd_exp.records.processes import announce
from phd_exp.records.recordings import MCAP, is_recording

if TYPE_CHECKING:  # imports of seconds, which follow the checks of the arguments
    from phd_exp.inference.predictor import Predictor

ONE_RUN = "coverage: scenes with several cameras are recorded by single runs; expected one run= and no views=8"
PLANE = four_numbers("plane=NX,NY,NZ,OFFSET: the points v with normal . v = offset, metres")


class FuseArguments(RunArguments):
    """The run and the scenes; the plane holds the v with (nx, ny, nz) . v = offset, world frame, metres."""

    folder: Path
    """images with a metadata.jsonl whose lines have a scene and a pose, or as BOP with poses of the cameras"""
    object: NumberOrName | None = None
    """BOP's obj_id; by default all objects"""
    plane: Annotated[tuple[float, float, float, float], PLANE] | None = None
    """NX,NY,NZ,OFFSET: the object lies on this plane, metres"""
    shared_scale: bool = False
    """estimate one factor that the depths of all views share, as they do in the run's recorded scenes"""
    beyond: Beyond = False
    coverage: Coverage = None
    out: Path | None = None
    """a file for the lines; or FILE.mcap for ROS 2 messages, in addition to printed lines"""
    view: Path | None = None
    """a new file *.rrd for the viewer Rerun: all cameras with their images and regions, and the fused position"""

    @field_validator("plane")
    @classmethod
    def a_plane(cls, plane: tuple[float, ...] | None) -> tuple[float, ...] | None:
        """Require finite numbers, and a normal that is not zero."""
        if plane and not (all(abs(number) <= 1e9 for number in plane) and max(map(abs, plane[:3])) >= 1e-9):
            raise ValueError("expected finite numbers up to 1e9, and a normal that is not zero")
        return plane

    @model_validator(mode="after")
    def of_recorded_scenes(self) -> Self:
        """Refuse a coverage that recorded scenes do not guarantee."""
        if self.coverage and (self.plane or self.shared_scale):
            raise ValueError("coverage: holds for views that are fused alone; omit plane= and shared_scale=")
        if self.coverage and self.views != "1":
            raise ValueError(ONE_RUN)
        if self.coverage and self.calibration:
            raise ValueError("coverage: recorded scenes of renders guarantee it; expected no calibration=")
        return self


def main(words: list[str]) -> int:
    """Fuse the predictions of each scene; returns the exit status, which is 1 if a scene has no result."""
    arguments = FuseArguments.parsed("fuse", words)
    out = arguments.out
    if is_recording(arguments.folder):
        raise ConfigError(
            f"folder={arguments.folder}: a recording has no poses of cameras; expected a folder with metadata.jsonl"
        )
    detections = detections_in(arguments.folder, object_name=arguments.object)
    scenes = observed(detections)
    if out is not None:
        inputs = [*annotations(arguments.folder)[0], *(detection.file for detection in detections)]
        require_output(out, f"fused{MCAP if out.suffix == MCAP else '.jsonl'}", arguments, inputs)
        output_folder(out.parent)
    if arguments.view is not None:
        new_view(arguments.view, arguments, [] if out is None else [out])
    with message_file(out) as messages:
        answers = _answers(arguments, scenes, messages)
    text = "".join(json.dumps(answer, allow_nan=False) + "\n" for answer in answers)
    if out is None or messages is not None:
        print(text, end="", flush=True)
    else:
        write_atomic(out, text)
    if out is not None:
        announce(f"{out}: {len(answers)} scenes")
    failed = [str(answer["scene"]) for answer in answers if answer["status"] != "fused"]
    if failed:
        count = f"{len(failed)} of {len(answers)} scenes have no fused position"
        announce(f"error: {count}: {listed(failed)}; the line of each says why")
    return 1 if failed else 0


def _answers(
    arguments: FuseArguments, scenes: Sequence[Observed], messages: MessageFile | None
) -> list[dict[str, Any]]:
    """Return the answers for JSON, and write them to `messages` and to the recording of view=."""
    # imports of seconds, which follow the checks of the arguments
    import torch

    from phd_exp.fusion import Plane
    from phd_exp.inference.fused import for_json, fused_answers, fused_region

    predictor = loaded(arguments)
    predictor.require_densities("fuse needs")
    guarantees, shared = _of_recorded_scenes(arguments, predictor, {len(scene.detections) for scene in scenes})
    numbers = torch.tensor(arguments.plane or (), dtype=torch.float64)
    plane = Plane(numbers[:3], numbers[3]) if arguments.plane else None
    detections = [detection for scene in scenes for detection in scene.detections]
    sightings = predicted(predictor, detections, beyond=arguments.beyond, needs_all=True)
    with ExitStack() as ends:
        if messages is not None:
            from phd_exp.inference.ros import write_fused, write_views

            sightings = write_views(messages, scenes, sightings)
        if arguments.view is not None:
            from phd_exp.inference.rerun_view import add_fused, of_scenes, viewed_scenes

            recording = ends.enter_context(of_scenes(arguments.view, scenes))
            sightings = viewed_scenes(recording, scenes, sightings)
        answers = fused_answers(scenes, sightings, predictor, plane, shared)
        if messages is not None:
            write_fused(messages, scenes, answers)
        if arguments.view is not None:
            add_fused(recording, answers)
    return [for_json(answer) | (fused_region(answer, guarantees) if guarantees else {}) for answer in answers]


def _of_recorded_scenes(
    arguments: FuseArguments, predictor: "Predictor", cameras: set[int]
) -> tuple[dict[int, dict[str, Any]], float | None]:
    """From the run's recorded scenes: the guarantee for each number of cameras (coverage=), and the share of the
    depth errors that is common to all views (shared_scale=).
    """
    import torch

    from phd_exp.evaluation.conformal import fused_guarantee
    from phd_exp.evaluation.fusion import shared_share
    from phd_exp.evaluation.several_views import read_views
    from phd_exp.training.tables import require_received

    file, guarantees, shared = predictor.folders[0].views, {}, None
    if arguments.coverage:
        if predictor.network.is_ensemble:
            raise ConfigError(ONE_RUN)
        require_received(file, predictor.config)
        guarantees = {k: fused_guarantee(file, k, arguments.coverage, predictor.temperature) for k in cameras}
    if arguments.shared_scale:
        require_received(file, predictor.config)
        if not file.exists():
            raise RunError(
                f"{file}: missing; shared_scale is estimated from it: train with evaluation.multiview.scenes=500"
            )
        views = read_views(file)
        shared = float(shared_share(views, torch.ones(views.n, dtype=torch.bool)))
    return guarantees, shared
