"""Pictures of clouds and the grasps found in them, drawn without a screen.

A picture is drawn through a pinhole camera: the camera that took the cloud, over its image if there
is one, or else a camera at the same position.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from edgegrasp_camera.arrays import Array, Bools, Float64, Floats, Int64
from edgegrasp_camera.clouds import CloudInput

PANDA_Z = (0.0658, 0.1122)  # metres along the hand's z: the palm's surface, the fingertips
STEM_LENGTH = 0.03  # metres drawn behind the palm, to show the approach
FORK_WIDTH = 0.005  # metres, thickness of a fork
FORK_POINTS = (2.0, 7.0)  # minimum and maximum of this thickness on paper, points
HIDDEN_DEPTH = 0.006  # metres behind the cloud from which a fork is drawn as hidden
MAX_DRAWN = 10  # grasps in a picture of a request
SHOWN_DISTANCE = 0.4  # metres around the grasps that a picture of a cloud shows
MAX_LABELLED = 5  # grasps that are labelled with their rank
CLOUD_PICTURE_SIZE = (960, 1280)  # rows and columns of a picture of a cloud without an image
MIN_SHOWN_EXTENT = 0.25  # metres, minimum width of the scene in such a picture
MAX_GAP_PIXELS = 8  # largest gap between points that is closed, pixels
WIDTH, DPI = 10.0, 130  # inches, dots per inch
CAPTION_INCHES = 0.75  # inches below the picture: title and scale
SMOOTHING_PASSES = 8  # smoothing passes over the depths before shading
LIGHT = (-0.3, -0.6, -0.74)  # direction from a surface to the light, camera frame
SCORE_COLOURS = "viridis"  # colours of scores from 0 to 1
OUTLINE_COLOUR = "#10151d"
REGION_COLOUR = "#4cc9f0"


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: column = fx * x / z + cx, row = fy * y / z + cy in its own frame."""

    shape: tuple[int, int]  # rows and columns of its image
    fx: float  # pixels, like the next three; negative if x or z points the other way
    fy: float
    cx: float
    cy: float
    # (4, 4); by default the cloud is in the camera's frame
    T_cloud_camera: Floats = field(default_factory=lambda: np.eye(4))
    ahead: float = 1.0  # -1 if z points backward

    @classmethod
    def facing(cls, points: ArrayLike, eye: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Self:
        """A camera at `eye` (3,) whose image contains most of the points (N, 3)."""
        seen = np.asarray(points, dtype=np.float64)
        (rows, columns), position = CLOUD_PICTURE_SIZE, np.asarray(eye, dtype=np.float64)
        z = np.median(seen, axis=0) - position
        z /= np.linalg.norm(z)
        x = np.cross(z, np.asarray(up, dtype=np.float64))
        x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), position
        right, down, ahead = ((seen - position) @ T[:3, :3]).T
        ahead = np.maximum(ahead, 0.05)
        (left, right), (top, bottom) = (np.quantile(v / ahead, (0.01, 0.99)) for v in (right, down))
        least = MIN_SHOWN_EXTENT / float(np.median(ahead))
        focal = 0.8 * min(columns / max(right - left, least), rows / max(bottom - top, least))
        middle = columns / 2 - focal * (left + right) / 2, rows / 2 - focal * (top + bottom) / 2
        return cls(CLOUD_PICTURE_SIZE, focal, focal, *middle, T)

    @classmethod
    def from_image(cls, points: Floats) -> Self | None:
        """The camera at the origin that saw an organised cloud (H, W, 3); None if none could."""
        rows, columns = np.nonzero(np.isfinite(points).all(axis=2) & (points[..., 2] != 0))
        if len(np.unique(rows)) < 2 or len(np.unique(columns)) < 2:
            return None
        x, y, z = points[rows, columns].T.astype(np.float64)
        numbers, worst = [], 0.0
        for slope, pixel in ((x / z, columns), (y / z, rows)):
            system = np.stack([slope, np.ones_like(slope)], axis=1)
            (focal, middle), *_ = np.linalg.lstsq(system, pixel)
            worst = max(worst, float(np.abs(system @ (focal, middle) - pixel).max()))
            numbers += [float(focal), float(middle)]
        fx, cx, fy, cy = numbers
        shape, ahead = (points.shape[0], points.shape[1]), float(np.sign(np.median(z)))
        return cls(shape, fx, fy, cx, cy, ahead=ahead) if worst < 1.0 else None

    def project(self, points: ArrayLike) -> tuple[Float64, Float64]:
        """Columns and rows (..., 2), and distances along the line of sight (...), metres."""
        turn, position = self.T_cloud_camera[:3, :3], self.T_cloud_camera[:3, 3]
        x, y, z = np.moveaxis((np.asarray(points, dtype=np.float64) - position) @ turn, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)
        return pixels, self.ahead * z

    def rows_of_pixels(self, points: ArrayLike) -> Int64:
        """(H, W) the row of the nearest point seen at each pixel; -1 where there is no point."""
        pixels, depth = self.project(points)
        seen = np.flatnonzero(np.isfinite(pixels).all(axis=1) & (depth > 0.0))
        seen = seen[np.argsort(-depth[seen], kind="stable")]  # near points cover distant points
        rows, columns = self.shape
        column, row = np.clip(np.rint(pixels[seen]), -1e6, 1e6).astype(np.int64).T
        within = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        seen, column, row = seen[within], column[within], row[within]
        gap = np.sqrt(rows * columns / max(len(seen), 1))  # pixels from point to point
        spread = int(min(1.2 * gap - 0.6, MAX_GAP_PIXELS))
        around = np.arange(-spread, spread + 1)
        column = np.add.outer(column, np.tile(around, len(around)))
        row = np.add.outer(row, np.repeat(around, len(around)))
        image = np.full((rows + 1, columns + 1), -1)  # with a border for points outside the image
        image[np.clip(row, -1, rows), np.clip(column, -1, columns)] = seen[:, None]
        return image[:-1, :-1]


class Picture:
    """A picture of a cloud; later drawings cover earlier ones."""

    def __init__(
        self,
        view: Camera,  # the camera
        points: ArrayLike,  # (N, 3) metres, cloud frame; NaN where there is no reading
        colors: NDArray[np.uint8] | None = None,  # (N, 3)
        image: NDArray[np.uint8] | None = None,  # (H, W, 3) of the camera; None: draw the cloud
        title: str = "",  # a line below the picture
    ) -> None:
        from matplotlib.figure import Figure

        self.view = view
        cloud = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        self.row_of_pixel = view.rows_of_pixels(cloud)
        seen = self.row_of_pixel >= 0
        depth = np.where(seen, view.project(cloud)[1][self.row_of_pixel], np.nan)
        self._depth = np.pad(depth, (0, 1), constant_values=np.nan)  # the border is outside
        if image is None:
            row = self.row_of_pixel
            drawn: Any = self._shaded(depth) if colors is None else colors.reshape(-1, 3)[row]
            image = np.where(seen[..., None], drawn, 255).astype(np.uint8)
        rows, columns = view.shape
        height = WIDTH * rows / columns
        self._figure = Figure(figsize=(WIDTH, height + CAPTION_INCHES), dpi=DPI)
        self._foot = CAPTION_INCHES / (height + CAPTION_INCHES)
        self._axes: Any = self._figure.add_axes((0, self._foot, 1, 1 - self._foot))
        self._axes.set_axis_off()
        self._axes.imshow(image)
        self._axes.autoscale(False)
        self._point = 72 * WIDTH / columns  # points that a pixel is wide
        where = 0.015, self._foot / 2
        self._figure.text(*where, title, fontsize=10, va="center", parse_math=False)

    def _shaded(self, depth: Float64) -> Float64:
        """(H, W, 3) the cloud in greys."""
        rows, columns = self.view.shape
        for _ in range(SMOOTHING_PASSES):  # removes the noise of the camera
            around = np.pad(depth, 1, mode="edge")
            parts = [around[y : y + rows, x : x + columns] for y, x in np.ndindex(3, 3)]
            near = [np.where(np.abs(part - depth) < HIDDEN_DEPTH, part, depth) for part in parts]
            depth = np.mean(near, axis=0)
        grey = 70 + 165 * shaded(depth, abs(self.view.fx), abs(self.view.fy))
        return np.repeat(grey[..., None], 3, axis=2)

    def outline(self, mask: Bools) -> None:
        """Draw the border of a mask (H, W) in white."""
        if mask.any():
            self._axes.contour(mask, [0.5], colors="white", linewidths=1.0)

    def regions(self, options: Mapping[str, Any]) -> None:
        """Draw the workspace and the boxes and spheres of the regions in a request's options."""
        workspace = options.get("workspace")
        drawn: list[Any] = [({"kind": "box", **workspace}, "-")] if workspace else []
        for name in ("approach_region", "contact_region"):
            region = options.get(name) or {}
            drawn += [(shape, "-") for shape in region.get("include", ())]
            drawn += [(shape, ":") for shape in region.get("exclude", ())]
        for shape, style in drawn:
            for line in _lines_of(shape):
                pixels, _ = self.view.project(line)
                self._axes.plot(*pixels.T, style, color=REGION_COLOUR, linewidth=1.6)

    def grasps(self, grasps: Sequence[Any], palm_and_tip: tuple[float, float] = PANDA_Z) -> None:
        """Draw a fork for every grasp, the best last, and the scale of their scores.

        Like a server's grasps, they have a score, a T_cloud_hand (4, 4) and a width in metres.
        """
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        scale: Any = ScalarMappable(Normalize(0.0, 1.0), SCORE_COLOURS)
        for rank, grasp in reversed(list(enumerate(grasps))):
            pieces = fork(grasp.T_cloud_hand, grasp.width, palm_and_tip)
            self._fork(pieces, scale.to_rgba(grasp.score))
            if rank < MAX_LABELLED and len(grasps) > 1:
                text = str(rank + 1)
                (x, y), _ = self.view.project(pieces[0, 0])
                box = {"boxstyle": "circle,pad=0.2", "fc": "white", "ec": OUTLINE_COLOUR, "lw": 0.6}
                self._axes.text(
                    x, y, text, fontsize=8, ha="center", va="center", bbox=box, clip_on=True
                )
        if len(grasps) > 1:
            axes = self._figure.add_axes((0.78, 0.62 * self._foot, 0.2, 0.16 * self._foot))
            bar = self._figure.colorbar(
                scale, cax=axes, orientation="horizontal", ticks=[0, 0.5, 1]
            )
            bar.set_label("score: probability that the grasp holds", fontsize=8, labelpad=1)
            bar.ax.tick_params(labelsize=8, length=2, pad=1)

    def _fork(self, pieces: Float64, color: Any) -> None:
        """Draw a fork, (4, 2, 3), faintly where the cloud hides it."""
        along = np.linspace(pieces[:, 0], pieces[:, 1], 17, axis=1)  # (4, 17, 3)
        pixels, depth = self.view.project(along)
        column, row = np.moveaxis(np.rint(pixels).astype(int), -1, 0)
        rows, columns = self.view.shape
        seen = self._depth[np.clip(row, -1, rows), np.clip(column, -1, columns)]  # (4, 17)
        hidden = depth > seen + HIDDEN_DEPTH
        wide = FORK_WIDTH * abs(self.view.fy) / np.median(depth) * self._point
        bar = float(np.clip(wide, *FORK_POINTS))
        for width, shade in ((bar + 1.6, OUTLINE_COLOUR), (bar, color)):
            for solid, alpha, cap in ((True, 1.0, "round"), (False, 0.25, "butt")):
                x, y = np.where((hidden ^ solid)[..., None], pixels, np.nan).T
                self._axes.plot(x, y, color=shade, linewidth=width, alpha=alpha, solid_capstyle=cap)

    def save(self, path: Path | BinaryIO) -> None:
        """Write a `.png` or `.jpg` file, whose folder must exist, or a PNG to a stream."""
        self._figure.savefig(path)


def draw_detection(
    path: Path | BinaryIO,  # `.png` or `.jpg` file to write, or a stream for a PNG
    detection: Any,  # the answer, of a client or of a detector
    sent: CloudInput,  # the cloud of the request
    options: Mapping[str, Any],  # of the request: its regions are drawn
    colors: Array | None = None,  # like `CloudInput.colors`; None: the cloud's colours, if any
    from_above: bool = False,  # whether to draw any cloud from above
) -> None:
    """Write a picture of a request and the best of its grasps.

    An organised cloud is drawn from its camera, in its colours if given; any other cloud is drawn
    from its viewpoint, or obliquely from above.
    """
    points = np.asarray(sent.points)
    flat, shown, image = points.reshape(-1, 3), detection.grasps[:MAX_DRAWN], None
    given, shades = sent.colors if colors is None else colors, None
    if given is not None:
        shades = np.asarray(given).reshape(-1, 3)
        shades = 255 * shades if shades.dtype.kind == "f" else shades
    view = None if from_above or points.ndim != 3 else Camera.from_image(points)
    if view is not None:
        image = None if shades is None else shades.reshape(points.shape).astype(np.uint8)
    else:
        seen = flat[np.isfinite(flat).all(axis=1)]
        middle = np.median([grasp.T_cloud_tcp[:3, 3] for grasp in shown] or seen, axis=0)
        near = seen[np.linalg.norm(seen - middle, axis=1) < SHOWN_DISTANCE]
        up = np.asarray(detection.up, dtype=np.float64)
        aside = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
        eye = middle + 0.6 * up - 0.5 * aside
        if not from_above:  # a cloud whose z points down is in its camera's frame
            other = np.zeros(3) if up[2] < 0 else eye + aside
            eyes = options.get("viewpoint"), sent.viewpoint, other
            eye = np.ravel(next(each for each in eyes if each is not None))[:3]
        view = Camera.facing(near if len(near) else seen, eye, up)
    title = f"the {len(shown)} best of {len(detection.grasps)} grasps, {detection.model}"
    picture = Picture(view, flat, shades, image, title)
    picture.regions(options)
    picture.grasps(shown, (detection.gripper.palm_z, detection.gripper.tip_z))
    picture.save(path)


def shaded(depth: Floats, fx: float, fy: float) -> Float64:
    """Brightness (H, W), 0 to 1, of a depth image lit from above the camera.

    `depth` is (H, W) metres along the line of sight, NaN where there is nothing; fx and fy pixels.
    """
    down, right = np.gradient(np.asarray(depth, dtype=np.float64))
    x, y = right * fx / depth, down * fy / depth
    # The surface's normal is (x, y, -1), not of unit length.
    facing = (LIGHT[0] * x + LIGHT[1] * y - LIGHT[2]) / np.sqrt(x**2 + y**2 + 1)
    return np.asarray(np.clip(np.nan_to_num(facing), 0.0, 1.0))


def fork(
    T_cloud_hand: ArrayLike, width: float, palm_and_tip: tuple[float, float] = PANDA_Z
) -> Float64:
    """A gripper's outline as four line pieces (4, 2, 3), cloud frame: stem, palm, both fingers.

    `width` is the distance between the fingers' inner faces in metres; `palm_and_tip` are the
    positions of the palm's surface and of the fingertips along the hand's z, metres.
    """
    half, (palm, tip) = width / 2, palm_and_tip
    in_hand = [
        [(0.0, 0.0, palm - STEM_LENGTH), (0.0, 0.0, palm)],
        [(0.0, -half, palm), (0.0, half, palm)],
        [(0.0, -half, palm), (0.0, -half, tip)],
        [(0.0, half, palm), (0.0, half, tip)],
    ]
    transform = np.asarray(T_cloud_hand, dtype=np.float64)
    return np.asarray(in_hand @ transform[:3, :3].T + transform[:3, 3])


def _lines_of(shape: Mapping[str, Any]) -> Iterator[Float64]:
    """Edges of a box, or circles on a sphere, as lines (K, 3); nothing for other shapes."""
    kind = shape.get("kind")
    if kind == "sphere":
        angle = np.linspace(0, 2 * np.pi, 60)
        circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        for turned in range(3):
            yield shape["center"] + shape["radius"] * np.roll(circle, turned, axis=1)
    elif kind in ("box", "oriented_box"):
        if kind == "box":
            low, high = np.asarray(shape["min"]), np.asarray(shape["max"])
            shape = {"center": (low + high) / 2, "half_extents": (high - low) / 2}
        *axis, w = np.asarray(shape.get("quaternion", (0.0, 0.0, 0.0, 1.0)))  # xyzw
        corners = np.moveaxis(2.0 * np.indices((2, 2, 2)) - 1.0, 0, 3) * shape["half_extents"]
        across = 2 * np.cross(axis, corners)
        corners = shape["center"] + corners + w * across + np.cross(axis, across)  # (2, 2, 2, 3)
        for along in range(3):
            yield from np.moveaxis(corners, along, 2).reshape(4, 2, 3)
