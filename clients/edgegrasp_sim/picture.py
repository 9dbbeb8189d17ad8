"""A picture of a cloud and the grasps found in it, as a person would want to see them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Points = NDArray[np.float64]


PALM_Z = 0.0658  # metres along the hand's z: the palm's surface
TIP_Z = 0.1122  # metres along the hand's z: the fingertips
STEM_LENGTH = 0.03  # metres drawn behind the palm, to show where the hand comes from
TICKS = 0.05  # metres between the ticks of an axis
MARGIN = 0.02  # metres around everything drawn
MAX_CLOUD_POINTS = 12_000  # more would only hide each other
LABELLED = 5  # grasps that carry their rank
CAPTION = (
    "grey: the cloud, lighter is higher    forks: palm and opened fingers, "
    "the stem shows where the hand comes from"
)
BEST_EDGE = "#d00000"
OUTLINE = "black"


class Drawable(Protocol):
    """A grasp that can be drawn, such as the client's or the detector's."""

    @property
    def score(self) -> float: ...  # noqa: D102
    @property
    def T_cloud_hand(self) -> NDArray[np.float32]: ...  # noqa: D102, N802  # (4, 4)
    @property
    def width(self) -> float: ...  # noqa: D102  # metres


def draw_grasps(
    path: Path | BinaryIO,
    cloud: ArrayLike,
    grasps: Sequence[Drawable],
    *,
    camera_position: ArrayLike,
    title: str,
) -> None:
    """Write a picture: the cloud and a fork for every gripper, seen by the camera and from above.

    A fork is a gripper's outline at the grasp: a stem where the hand comes from, the palm's
    surface, and the inner faces of the fingers at the opening they start from.

    Args:
        path: `.png` or `.jpg` file to write, whose folder must exist; or where to write a PNG.
        cloud: (N, 3) metres.
        grasps: best first; coloured by score, the best one edged in red.
        camera_position: (3,) metres, cloud frame; the first view looks from there.
        title: one line above the picture.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    points = np.asarray(cloud, dtype=np.float64)
    if len(points) > MAX_CLOUD_POINTS:
        points = points[np.linspace(0, len(points) - 1, MAX_CLOUD_POINTS).astype(int)]
    camera = np.asarray(camera_position, dtype=np.float64)
    forks = [fork(grasp.T_cloud_hand, grasp.width) for grasp in grasps]
    scores = np.array([grasp.score for grasp in grasps] or [0.0])
    colours = ScalarMappable(
        Normalize(min(scores.min(), scores.max() - 0.01), scores.max()), colormaps["plasma"]
    )
    low = np.min([points.min(0), *(f.min((0, 1)) for f in forks)], axis=0) - MARGIN
    high = np.max([points.max(0), *(f.max((0, 1)) for f in forks)], axis=0) + MARGIN

    figure = Figure(figsize=(17, 8.4), dpi=110)
    figure.suptitle(title, fontsize=16)
    perspective: Any = figure.add_axes((0.01, 0.07, 0.52, 0.82), projection="3d")
    above: Any = figure.add_axes((0.56, 0.10, 0.35, 0.76))
    _draw_perspective(perspective, points, camera, low, high)
    _draw_above(above, points, low, high)
    for rank, lines in reversed(list(enumerate(forks))):
        colour = colours.to_rgba(scores[rank])
        for axes, dimensions in ((perspective, 3), (above, 2)):
            draw_fork(axes, lines[..., :dimensions], colour, rank, labelled=len(forks) > 1)
    figure.text(0.5, 0.015, CAPTION, fontsize=12, ha="center")
    if len(forks) > 1:
        bar = figure.colorbar(colours, cax=figure.add_axes((0.935, 0.14, 0.014, 0.68)))
        bar.set_label("score: probability that the grasp holds", fontsize=13)
        bar.ax.tick_params(labelsize=12)
    figure.savefig(path)


def fork(T_cloud_hand: ArrayLike, width: float) -> Points:
    """A gripper's outline as four line pieces: stem, palm, both fingers.

    Args:
        T_cloud_hand: (4, 4), z out of the palm, y the closing direction.
        width: metres between the fingers' inner faces.

    Returns:
        (4, 2, 3) ends of each piece, metres, cloud frame.
    """
    half = width / 2
    in_hand = np.array(
        [
            [(0.0, 0.0, PALM_Z - STEM_LENGTH), (0.0, 0.0, PALM_Z)],
            [(0.0, -half, PALM_Z), (0.0, half, PALM_Z)],
            [(0.0, -half, PALM_Z), (0.0, -half, TIP_Z)],
            [(0.0, half, PALM_Z), (0.0, half, TIP_Z)],
        ]
    )
    transform = np.asarray(T_cloud_hand, dtype=np.float64)
    in_cloud: Points = in_hand @ transform[:3, :3].T + transform[:3, 3]
    return in_cloud


def _greys(points: Points) -> Points:
    """Grey by height, lighter above, none so dark or light that a fork gets lost: (N, 3)."""
    z = points[:, 2]
    level = (z - z.min()) / max(float(np.ptp(z)), 1e-6)
    greys: Points = np.repeat(0.42 + 0.4 * level[:, None], 3, axis=1)
    return greys


def _draw_perspective(axes: Any, points: Points, camera: Points, low: Points, high: Points) -> None:
    from matplotlib.ticker import MultipleLocator

    centre = (low + high) / 2
    x, y, z = camera - centre
    axes.set_proj_type("persp")
    axes.computed_zorder = False  # grippers in front of the cloud
    axes.view_init(
        elev=np.degrees(np.arctan2(z, np.hypot(x, y))), azim=np.degrees(np.arctan2(y, x))
    )
    axes.scatter(*points.T, c=_greys(points), s=5)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(high - low, zoom=1.0)
    axes.set_title(
        "as seen from the camera at x {:.2f}, y {:.2f}, z {:.2f} m".format(*camera), fontsize=13
    )
    for name in "xyz":
        getattr(axes, f"set_{name}label")(f"{name} (m)", fontsize=12, labelpad=8)
        getattr(axes, f"{name}axis").set_major_locator(MultipleLocator(TICKS))
    axes.tick_params(labelsize=10)


def _draw_above(axes: Any, points: Points, low: Points, high: Points) -> None:
    from matplotlib.ticker import MultipleLocator

    upward = points[np.argsort(points[:, 2])]
    axes.scatter(*upward[:, :2].T, c=_greys(upward), s=7)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set_title("from above, looking along -z", fontsize=13)
    axes.set_xlabel("x (m)", fontsize=12)
    axes.set_ylabel("y (m)", fontsize=12)
    axes.xaxis.set_major_locator(MultipleLocator(TICKS))
    axes.yaxis.set_major_locator(MultipleLocator(TICKS))
    axes.tick_params(labelsize=11)
    axes.grid(alpha=0.25)
    axes.set_axisbelow(True)


def draw_fork(axes: Any, lines: Points, colour: Any, rank: int, *, labelled: bool) -> None:
    """Draw the pieces of a fork, (4, 2, 2) or (4, 2, 3), the best (rank 0) edged in red."""
    best = rank == 0
    layer = 1000 - rank
    for width, shade in (
        ((7.0, BEST_EDGE), (4.0, colour)) if best else ((3.2, OUTLINE), (2.0, colour))
    ):
        for piece in lines:
            axes.plot(*piece.T, color=shade, linewidth=width, solid_capstyle="round", zorder=layer)
    if labelled and rank < LABELLED:
        axes.text(
            *lines[0, 0],
            "1 (best)" if best else str(rank + 1),
            fontsize=13 if best else 11,
            fontweight="bold",
            color=BEST_EDGE if best else OUTLINE,
            ha="center",
            va="bottom",
            zorder=2000,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.75},
        )
