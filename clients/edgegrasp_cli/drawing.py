"""Pictures of a request and its answer, for commands: files are read as a server reads them."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from edgegrasp_camera.arrays import Array
from edgegrasp_camera.clouds import CloudInput
from edgegrasp_camera.depth import DepthView, fuse_depth_images, intrinsics_of
from edgegrasp_camera.files import read_file, read_npy, read_png

if TYPE_CHECKING:
    from edgegrasp_client import DepthImage, Detection

DRAWN = 10  # grasps in a picture
AROUND = 0.4  # metres from the grasps: what a picture of a cloud shows


def pixels(file: Path) -> Array:
    """The values of an image file, .png or .npy: (H, W), or (H, W, C) of several channels."""
    read = read_png if file.suffix.lower() == ".png" else read_npy
    return read(file.read_bytes(), sys.maxsize, file.name)


def sent_cloud(file: Path | None, images: "Sequence[DepthImage] | None") -> CloudInput:
    """The cloud of a request: that of a file, or of depth images whose depths are files."""
    if file is not None:
        return read_file(file.suffix[1:].lower(), file.read_bytes(), sys.maxsize)
    views = [
        DepthView(
            intrinsics_of(image["intrinsics"]),
            image.get("T_cloud_camera", np.eye(4)),
            image.get("depth_scale"),
        )
        for image in images or ()
    ]
    return fuse_depth_images([pixels(Path(str(image["depth"]))) for image in images or ()], views)[
        0
    ]


def draw(
    path: Path | BinaryIO,
    detection: "Detection",
    sent: CloudInput,
    options: Mapping[str, Any],
    colors: Array | None = None,
    from_above: bool = False,
) -> None:
    """Write a picture of a request and the best of its grasps.

    What is organised as a camera's image is drawn as that camera saw it, in its colours where they
    are given; another cloud from its viewpoint, or from above at a slant.

    Args:
        path: `.png` or `.jpg` file to write, or where to write a PNG.
        detection: The answer.
        sent: The cloud of the request.
        options: Of the request: its regions are drawn.
        colors: As `CloudInput.colors`; None: those of the cloud, if any.
        from_above: Whether to look from above, whatever the cloud.
    """
    from edgegrasp_camera.picture import Picture, View

    points = np.asarray(sent.points)
    flat, shown, image = points.reshape(-1, 3), detection.grasps[:DRAWN], None
    given, shades = sent.colors if colors is None else colors, None
    if given is not None:
        shades = np.asarray(given).reshape(-1, 3)
        shades = 255 * shades if shades.dtype.kind == "f" else shades
    view = None if from_above or points.ndim != 3 else View.of_image(points)
    if view is not None:
        image = None if shades is None else shades.reshape(points.shape).astype(np.uint8)
    else:
        seen = flat[np.isfinite(flat).all(axis=1)]
        middle = np.median([grasp.T_cloud_tcp[:3, 3] for grasp in shown] or seen, axis=0)
        near = seen[np.linalg.norm(seen - middle, axis=1) < AROUND]
        up = np.asarray(detection.up, dtype=np.float64)
        aside = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
        given = None if from_above else options.get("viewpoint")
        eye = middle + 0.6 * up - 0.5 * aside if given is None else np.ravel(given)[:3]
        view = View.of(near if len(near) else seen, eye, up)
    title = f"the {len(shown)} best of {len(detection.grasps)} grasps, {detection.model}"
    picture = Picture(view, flat, shades, image, title)
    picture.regions(options)
    picture.grasps(shown, (detection.gripper.palm_z, detection.gripper.tip_z))
    picture.save(path)
