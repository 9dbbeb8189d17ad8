"""Renders the pictures of docs/cameras.md: `python docs/make_camera_pictures.py`."""

import runpy
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from edgegrasp_cli.detect import OwnDetector, draw
from edgegrasp_sim.sensor import SENSORS

DOCS = Path(__file__).parent
SIZE = (720, 594)  # pixels of a picture
SEED = 3


def main() -> None:
    """Write a picture for each sensor model, and one in colour."""
    example = runpy.run_path(str(DOCS.parent / "examples" / "04_depth_camera.py"))
    detector = OwnDetector((), (), "cpu")
    with tempfile.TemporaryDirectory() as folder:
        for sensor in SENSORS:
            example["write_images"](Path(folder), sensor, SEED)
            depth = Path(folder) / "depth.png"
            images: list[Any] = [{"depth": depth, "intrinsics": example["INTRINSICS"]}]
            found = detector.detect(depth_images=images)
            draw(DOCS / "cameras" / f"{sensor}.jpg", found, {}, depth_images=images)
        with Image.open(Path(folder) / "color.png") as color:
            pixels = np.asarray(color)
        path = DOCS / "cameras" / "color.jpg"  # the last image's grasps
        draw(path, found, {}, depth_images=images, colors=pixels)
    for file in (DOCS / "cameras").glob("*.jpg"):
        with Image.open(file) as drawn:
            small = drawn.resize(SIZE, Image.Resampling.LANCZOS)
        small.save(file, quality=85)


if __name__ == "__main__":
    main()
