"""The cylinder's pixels of every sample, as images of one bit: from the records, without Blender."""

from pathlib import Path

from PIL import Image

from phd_exp.records.dataset import SPLITS, DatasetFolder
from phd_exp.records.errors import RenderError, writing
from phd_exp.records.files import write_atomic
from phd_exp.rendering.pixels import file_of
from phd_exp.rendering.progress import shown_progress
from phd_exp.rendering.rays import cylinder_mask, trace_pixels


def write_masks(folder: DatasetFolder, masks: Path) -> int:
    """Write `<masks>/<split>/<index>.png`, white where the cylinder shows, for all samples; returns their number.

    Raises:
        DatasetError: there is no data set, or a broken one.
        RenderError: the masks cannot be written, or would lie among the images.
    """
    require_elsewhere(folder, masks)
    records = [record for split in SPLITS for record in folder.records(split)]
    with writing(masks, instead="masks=FOLDER"):
        for split in SPLITS:
            (masks / split).mkdir(parents=True, exist_ok=True)
        with shown_progress(len(records), "drawing masks") as advance:
            for record in records:
                image = Image.fromarray(cylinder_mask(trace_pixels(record.shown)))
                path = (masks / record.split / record.file_name).with_suffix(".png")
                write_atomic(path, file_of(image, "png"))
                advance()
    return len(records)


def require_elsewhere(folder: DatasetFolder, masks: Path) -> None:
    """Raise RenderError where masks would lie among the images: loaders would take them for samples."""
    if masks.absolute().is_relative_to(folder.root):
        raise RenderError(
            f"masks={masks}: lies in the data set itself; expected a folder outside {folder.root}"
        )
