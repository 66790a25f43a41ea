"""What leads a reader to a page: pictures, and a search that ranks guides first and knows other words for them."""

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

PICTURES = Path(__file__).parents[2] / "renders"
RANKS = {"api": 0.1, "guides": 10.0, "index.md": 10.0}
"""First part of an address -> the factor of a page's score in the search."""

WORDS = {
    "guides/guarantee.md": ["confidence", "coverage", "conformal prediction"],
    "guides/own_object.md": ["CAD", "mesh", "synthetic images"],
    "guides/own_images.md": ["annotation", "bounding box", "fine-tune"],
    "guides/predict.md": ["inference", "confidence", "deploy"],
    "guides/ros.md": ["ROS2", "rosbag", "MCAP", "Foxglove", "rclpy", "robot"],
    "guides/search.md": ["hyperparameter", "tune"],
    "guides/several_cameras.md": ["stereo", "triangulation"],
    "guides/sharing.md": ["install", "docker", "publish", "model card"],
    "guides/shift.md": ["robustness", "out of distribution"],
    "guides/tracking.md": ["video", "sequence", "Kalman filter", "smoother", "trajectory"],
    "ideas/calibration.md": ["confidence", "reliability"],
    "ideas/density.md": ["loss", "likelihood"],
    "index.md": ["licence", "license", "citation", "install"],
}
"""Address -> words that the search takes for the page's."""


def on_files(files: Files, *, config: Any) -> Files:
    """Called by MkDocs: adds the pictures of the README."""
    for file in (*PICTURES.glob("*.png"), *PICTURES.glob("*.jpg")):
        files.append(File.generated(config, f"renders/{file.name}", abs_src_path=str(file)))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for each page, whose links to `renders/` stay valid in the checkout too."""
    address = page.file.src_uri
    page.meta["search"] = {"boost": RANKS.get(address.partition("/")[0], 1.0)}
    page.meta["tags"] = WORDS.get(address, [])
    return markdown.replace("](../renders/", "](renders/")
