"""Predictions of the user's labelled images, which `calibrate` records in the folder of a run."""

from collections.abc import Sequence

import numpy as np
import torch

from phd_exp.data.batches import Batch
from phd_exp.data.sources import blocks
from phd_exp.distributions.columns import Columns
from phd_exp.inference.answers import sightings
from phd_exp.inference.predictor import Predictor
from phd_exp.records.detections import Detection
from phd_exp.records.errors import RunError
from phd_exp.records.files import make_folder
from phd_exp.training.predictions import columns, joined, write_parquet


def record_labelled(predictor: Predictor, detections: Sequence[Detection], name: str) -> Columns:
    """Predict the user's labelled images and write the table NAME of `calibrate`; returns its columns.

    Raises DatasetError if a label is missing or in millimetres, ConfigError for a baseline.
    """
    folder, parts, n = predictor.folders[0], list[Columns](), 0
    if predictor.network.is_ensemble or predictor.state != "finished":
        raise RunError(f"{folder.path}: expected a single run, which is finished")
    predictor.require_densities("calibrate needs")
    for answers in dict.fromkeys(sighting.answers for sighting in sightings(predictor, detections)):
        found, labelled = answers.found, zip(answers.detections, answers.found.views, strict=True)
        xyz = np.stack([view.camera.to_virtual(np.array(one.position)) for one, view in labelled])
        images = torch.from_numpy(np.stack([view.image for view in found.views]))
        rows, truth = torch.arange(n, n + len(images)), torch.from_numpy(xyz)
        samples = Batch(images, truth, found.f.float(), float(predictor.side), rows)
        parts.append(columns(found.predictions, samples))
        n += len(images)
    table = joined(parts)
    table["margin"] = torch.full_like(table["f"], predictor.margin)
    file = folder.labelled(name)
    with folder.held():
        make_folder(file.parent)
        lines = [one.line for one in detections]
        write_parquet(file, table, {"file_name": [line.file_name for line in lines], **blocks(lines)})
    return table
