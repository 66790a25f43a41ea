"""Records of sequences whose motion and slow errors are known."""

from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from phd_exp.data.batches import Batch
from phd_exp.evaluation.several_views import ROTATION, TRANSLATION
from phd_exp.fusion.tracks import ConstantVelocity, Slow
from phd_exp.training.predictions import columns, write_parquet
from tests.support.paths import HERTZ, NO_ERRORS, Errors, around, drawn_paths

MOTION = ConstantVelocity(noise=0.3, speed=0.3)
CAMERA = 1  # of two
ERRORS = Errors(deviation=0.05, depth_time=1.0, share=0.4, projection_time=0.5)
SLOW = Slow(0.38 * 1.0, 0.4 * 0.5)  # the integrals of their autocorrelations, 38 % and 40 % of the variance


def write_sequences(
    file: Path, n: int, frames: int, *, cameras: int = 1, errors: Errors = NO_ERRORS, seed: int = 0
) -> None:
    """`n` sequences at 30 Hz; one camera is not the world's. Every third frame counts as hidden."""
    pose, times = around(2), np.arange(frames) / HERTZ
    drawn, truth = drawn_paths(n, times, MOTION, pose, errors=errors, seed=seed)
    rows = torch.arange(n * frames * cameras)
    frame, view = rows // cameras, rows % cameras
    camera = (view + CAMERA) % 2
    place = (frame // frames, frame % frames, camera)
    xyz = pose.into_camera(truth[:, :, None])[place]
    image = torch.zeros(len(rows), 1, 1, 3, dtype=torch.uint8)
    batch = Batch(image, xyz, torch.full((len(rows),), 1500.0), S=224.0, row=rows)
    table = columns(drawn[place], batch)
    quaternion = np.roll(Rotation.from_matrix(pose.R.numpy()).as_quat(), 1, axis=-1)
    numbers = np.concatenate([quaternion, pose.t.numpy()], -1)[camera].T.tolist()
    known = dict(zip((*ROTATION, *TRANSLATION), numbers, strict=True))
    known |= {"scene": frame.tolist(), "view": view.tolist(), "scale": [1.0] * len(rows)}
    known |= {"track": (frame // frames).tolist(), "time": times[frame % frames].tolist()}
    known |= {"visibility": torch.where(frame % 3 == 0, 0.1, 1.0).tolist()}
    file.parent.mkdir(parents=True, exist_ok=True)
    write_parquet(file, table, known)
