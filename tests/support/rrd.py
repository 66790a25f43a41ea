"""Recordings of Rerun, read by its own readers: that of its dataframes before version 0.26, later that of chunks."""

from pathlib import Path
from typing import Any

import pytest

Rows = dict[str, dict[str, dict[Any, Any]]]
"""Entity -> component -> time -> value."""
COMPONENTS = {
    "Position3D": "positions",
    "TriangleIndices": "triangles",
    "PinholeProjection": "K",
    "TransformMat3x3": "R",
    "Translation3D": "t",
    "LineStrip2D": "strips",
    "LineStrip3D": "strips",
    "HalfSize3D": "half_sizes",
    "PoseTranslation3D": "centers",
    "Blob": "blob",
    "Scalar": "scalars",
    "vertex_positions": "positions",
    "triangle_indices": "triangles",
    "image_from_camera": "K",
    "mat3x3": "R",
    "translation": "t",
}
"""Names of either reader -> ours; others stay."""


def read_rrd(file: Path, timeline: str) -> Rows:
    """All values on a timeline. Skips where Rerun is not installed."""
    rerun = pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install 'phd_exp[rerun]'")
    found: Rows = {}
    if hasattr(rerun, "dataframe"):
        table = rerun.dataframe.load_recording(file).view(index=timeline, contents="/**").select().read_all()
        tables = [("", table)]
    else:
        from rerun.chunk import RrdReader

        chunks = (chunk for chunk in RrdReader(file).stream() if timeline in chunk.timeline_names)
        tables = [(f"{chunk.entity_path}:", chunk.to_record_batch()) for chunk in chunks]
    for entity, table in tables:
        times = table.column(timeline).to_pylist()
        for name, column in zip(table.schema.names, table.columns, strict=True):
            place, _, component = f"{entity}{name}".partition(":")
            component = component.rpartition(":")[2]
            if component in ("", timeline, "log_tick", "log_time", "rerun.controls.RowId"):
                continue
            values = {time: one for time, one in zip(times, column.to_pylist(), strict=True) if one is not None}
            found.setdefault(place, {}).setdefault(COMPONENTS.get(component, component), {}).update(values)
    return found
