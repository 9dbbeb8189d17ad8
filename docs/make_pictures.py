"""Draws the pictures of docs/frames.md: `python docs/make_pictures.py [folder]`."""

import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Polygon, Rectangle, Wedge
from numpy.typing import NDArray

from edgegrasp_model.candidates.sample import SIDE_ANGLE, TOP_DOWN_ANGLE
from edgegrasp_model.gripper import Gripper, gripper_names, load_gripper

Float64 = NDArray[np.float64]

X, Y, Z = "#c0392b", "#1e8449", "#1f4e9c"  # colours of the axes
HAND, FINGER, EDGE = "#e4e7ec", "#c5ccd6", "#444444"
OBJECT, RED, GREY, GOOD = "#f3dfb6", "#b3261e", "#666666", "#1e8449"
DOWN = np.array([[1.0, 0.0], [0.0, -1.0]])  # columns: the hand's y and z on the paper, hand above


def arrow(ax: Axes, start: Float64, end: Float64, color: str, width: float = 2.2) -> None:
    """An arrow between two points of the paper."""
    style = {"arrowstyle": "-|>", "color": color, "lw": width, "mutation_scale": 14}
    ax.annotate("", tuple(end), tuple(start), arrowprops={**style, "shrinkA": 0, "shrinkB": 0})


def dimension(ax: Axes, start: Float64, end: Float64, label: str, offset: Float64) -> None:
    """A length between two points, its label moved off the middle."""
    style = {"arrowstyle": "<|-|>", "color": GREY, "lw": 1.1, "mutation_scale": 9}
    ax.annotate("", tuple(end), tuple(start), arrowprops={**style, "shrinkA": 0, "shrinkB": 0})
    x, y = (np.asarray(start) + np.asarray(end)) / 2 + offset
    ax.text(x, y, label, color=GREY, ha="center", va="center", fontsize=10)


def hand(
    ax: Axes,
    gripper: Gripper,
    opening: float,
    origin: Float64,
    axes: Float64 = DOWN,
    alpha: float = 1.0,
) -> None:
    """The boxes of a gripper seen along its x.

    Args:
        ax: Where to draw.
        gripper: What to draw.
        opening: Metres between the fingers.
        origin: (2,) of the hand frame on the paper.
        axes: (2, 2) columns: the hand's y and z on the paper.
        alpha: Opacity.
    """
    hands = len(gripper.hand_boxes)
    for number, (low, high) in enumerate(gripper.boxes(opening)[:, :, 1:]):
        corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        color = HAND if number < hands else FINGER
        outline = Polygon(corners @ axes.T + origin, closed=True, fc=color, ec=EDGE, lw=1.0)
        outline.set_alpha(alpha)
        ax.add_patch(outline)


def frame(ax: Axes, origin: Float64, name: str, length: float, axes: Float64 = DOWN) -> None:
    """A frame's axes; x points into the paper."""
    for color, direction, label in ((Y, axes[:, 0], "y"), (Z, axes[:, 1], "z")):
        arrow(ax, origin, origin + length * direction, color)
        x, y = origin + 1.18 * length * direction
        ax.text(x, y, label, color=color, ha="center", va="center", weight="bold", fontsize=11)
    radius = length * 0.11
    ax.add_patch(Circle(tuple(origin), radius, fc="white", ec=X, lw=1.8, zorder=5))
    for slope in (1, -1):
        step = radius * 0.7 * np.array([1, slope])
        ends = np.array([origin - step, origin + step])
        ax.plot(*ends.T, color=X, lw=1.5, zorder=6)
    x, y = origin - 1.5 * length * np.abs(axes[:, 0]) * np.array([0.35, 0.0])
    backing = {"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1.0}
    ax.text(x, y, name, ha="right", va="center", weight="bold", fontsize=10, zorder=6, bbox=backing)


def grippers() -> Figure:
    """Every gripper that ships: boxes, hand frame, TCP frame and heights along z."""
    shown = sorted((load_gripper(name) for name in gripper_names()), key=lambda g: g.max_tip_z)
    rows = [shown[start : start + 2] for start in range(0, len(shown), 2)]
    reach = [max(gripper.max_tip_z for gripper in row) + 0.07 for row in rows]
    figure, panels = plt.subplots(
        len(rows),
        2,
        figsize=(11, 16.2 * (sum(reach) + 0.06 * len(rows)) + 0.6),
        layout="constrained",
        height_ratios=[each + 0.06 for each in reach],
        squeeze=False,
    )
    for row, axes, down in zip(rows, panels, reach, strict=True):
        for ax, gripper in zip(axes, row, strict=False):
            _gripper_panel(ax, gripper)
            ax.set(xlim=(-0.125, 0.215), ylim=(-down, 0.06), aspect="equal")
        for ax in axes:
            ax.axis("off")
    figure.suptitle(
        "Hand frame and TCP frame of each gripper, seen from the front: x points into the page.\n"
        "Fingers fully open; dotted: their tips closed. Heights are metres along the hand's z.",
        fontsize=12,
    )
    return figure


def _gripper_panel(ax: Axes, gripper: Gripper) -> None:
    origin, hands = np.zeros(2), len(gripper.hand_boxes)
    hand(ax, gripper, gripper.max_opening, origin)
    closed = gripper.boxes(0.0)[hands:, :, 1:]
    for low, high in closed[closed[:, 1, 1] > closed[:, 1, 1].max() - 1e-6]:
        size = high - low
        corner = (low[0], -high[1])
        ax.add_patch(Rectangle(corner, *size, fill=False, ec=GREY, ls=":", lw=1.1))
    frame(ax, origin, "hand", 0.03)
    frame(ax, np.array([0.0, -gripper.tcp_z]), "TCP", 0.02)
    heights = [
        (0.0, "hand frame"),
        (gripper.palm_z, "palm"),
        (gripper.contact_z, "contact"),
        (gripper.tip_z, "fingertips"),
        (gripper.tcp_z, "TCP"),
    ]
    if gripper.linkage is not None:
        heights.append((gripper.tip_z + float(gripper.tip_advance(0.0)), "fingertips, closed"))
    _heights(ax, heights)
    half, below = gripper.max_opening / 2, -gripper.max_tip_z - 0.042
    dimension(
        ax,
        np.array([-half, below]),
        np.array([half, below]),
        f"max_opening {gripper.max_opening:g}",
        np.array([0, -0.010]),
    )
    for side in (-half, half):
        ax.plot([side, side], [-gripper.tip_z, below], color=GREY, lw=0.6)
    ax.text(-0.12, 0.045, gripper.name, weight="bold", fontsize=13, va="center")


def _heights(ax: Axes, heights: list[tuple[float, str]]) -> None:
    """Ticks at heights along z with labels that do not overlap."""
    merged: dict[float, list[str]] = {}
    for height, label in heights:
        merged.setdefault(round(height, 4), []).append(label)
    line, last = 0.118, 1.0
    ordered = sorted(merged.items())
    for height, labels in ordered:
        place = min(-height, last - 0.0135)
        last = place
        ax.plot([line, line + 0.006, line + 0.012], [-height, -height, place], color=GREY, lw=0.9)
        ax.text(line + 0.014, place, f"{height:g}  {', '.join(labels)}", va="center", fontsize=9.5)
    ax.plot([line, line], [-ordered[0][0], -ordered[-1][0]], color=GREY, lw=0.9)


def edge_grasp() -> Figure:
    """An edge grasp: approach point, contact point, its normal and the hand they define."""
    panda = load_gripper("panda")
    figure, ax = plt.subplots(figsize=(11.5, 5.2), layout="constrained")
    p_a, p_c = np.array([0.0, 0.0]), np.array([0.024, -0.018])
    depth = p_a[1] - p_c[1]
    origin = np.array([0.0, panda.contact_z - depth])
    width, height = p_c[0], 0.052
    box = Rectangle((-width, -height), 2 * width, height, fc=OBJECT, ec="#9a7b2d", lw=1.6)
    hand(ax, panda, 0.066, origin)
    ax.add_patch(box)
    ax.plot([-0.115, 0.115], [-height, -height], color="#888888", lw=3)
    ax.text(-0.112, -height - 0.006, "support plane", color=GREY, va="center", fontsize=10)
    rng = np.random.default_rng(0)
    sides = np.concatenate(
        [
            np.stack([np.linspace(-width, width, 13), np.zeros(13)], axis=1),
            np.stack([np.full(12, width), np.linspace(-0.004, -height + 0.003, 12)], axis=1),
            np.stack([np.full(12, -width), np.linspace(-0.004, -height + 0.003, 12)], axis=1),
        ]
    )
    ax.plot(*(sides + rng.normal(scale=4e-4, size=sides.shape)).T, ".", color="#7a5f1c", ms=4)
    frame(ax, origin, "hand", 0.026)
    ax.plot([0, 0], [origin[1] - 0.03, 0.002], color=Z, lw=1.0, ls=(0, (4, 4)))
    corner = np.array([p_a[0], p_c[1]])
    arrow(ax, p_a, p_c, EDGE, 1.8)
    ax.text(0.0125, -0.0055, "r", fontsize=12, style="italic")
    arrow(ax, p_a, corner, Z, 2.2)
    ax.text(-0.003, -0.009, "$r_\\perp$", color=Z, fontsize=13, ha="right", va="center")
    ax.plot([corner[0], p_c[0]], [corner[1], p_c[1]], color=GREY, lw=1.0, ls=":")
    arrow(ax, p_c, p_c + np.array([0.042, 0.0]), RED, 2.4)
    for point, label, place in (
        (p_a, "approach\npoint $p_a$", (-0.019, 0.0105)),
        (p_c, "contact point $p_c$", (0.094, -0.036)),
    ):
        ax.plot(*point, "o", color=RED, ms=8, zorder=7)
        ax.annotate(
            label,
            tuple(point),
            place,
            color=RED,
            fontsize=12,
            weight="bold",
            ha="center",
            va="center",
            zorder=8,
            arrowprops={"arrowstyle": "-", "color": RED, "lw": 0.8},
        )
    ax.text(0.068, -0.0135, "normal $n_c$", color=RED, fontsize=12, weight="bold")
    dimension(
        ax,
        np.array([-0.109, 0.0]),
        np.array([-0.109, -depth]),
        "depth d",
        np.array([-0.015, 0.0]),
    )
    ax.plot([-0.112, 0.0], [0, 0], color=GREY, lw=0.6, ls=":", zorder=0)
    ax.plot([-0.112, 0.0], [-depth, -depth], color=GREY, lw=0.6, ls=":", zorder=0)
    notes = [
        "$r = p_c - p_a$",
        "$r_\\perp = r - (r \\cdot n_c)\\, n_c$:  the part of r across the normal",
        "$d = |r_\\perp|$",
        "hand z = $r_\\perp$ / d:  the way the hand moves",
        "hand y = $n_c$:  the fingers close along it",
        "hand $x = y \\times z$",
        f"the contact lies at z = {panda.contact_z:g} of the hand,",
        f"{1000 * (panda.tip_z - panda.contact_z):.0f} mm inside the fingertips",
    ]
    for row, note in enumerate(notes):
        ax.text(0.122, 0.09 - 0.0135 * row, note, fontsize=11, va="center")
    ax.set(xlim=(-0.13, 0.29), ylim=(-0.064, 0.117), aspect="equal")
    ax.axis("off")
    return figure


def approach_direction() -> Figure:
    """The sign of approach_direction, a cone, and the two presets."""
    figure, panels = plt.subplots(1, 3, figsize=(14, 4.7), layout="constrained")
    _cone_panel(panels[0])
    _preset_panel(panels[1], "top-down", TOP_DOWN_ANGLE, "around straight down, against up")
    _preset_panel(panels[2], "side", SIDE_ANGLE, "around level, any heading")
    figure.suptitle(
        "approach_direction is the way the hand MOVES: toward the object, +z of the hand",
        fontsize=14,
        weight="bold",
    )
    return figure


def _cone_panel(ax: Axes) -> None:
    came, half = 55.0, 25.0  # degrees: where the hand comes from, and the cone's angle
    out = _unit(came)
    _object(ax)
    _allowed(ax, came, half)
    _hand_from(ax, came)
    arrow(ax, 0.29 * out, 0.17 * out, RED, 3.6)
    x, y = 0.30 * out
    ax.text(x, y + 0.006, "direction", color=RED, fontsize=12, weight="bold", ha="center")
    arc = np.stack([_unit(angle) for angle in np.linspace(came, came + half, 20)])
    ax.plot(*(0.235 * arc).T, color=GOOD, lw=1.6)
    ax.plot(*np.stack([0.0 * out, 0.26 * out]).T, color=GOOD, lw=0.9, ls="--")
    x, y = 0.285 * _unit(came + 0.7 * half)
    ax.text(x, y, "max_angle", color=GOOD, fontsize=12, ha="right")
    for wrong in (165.0, 195.0):
        arrow(ax, 0.25 * _unit(wrong), 0.12 * _unit(wrong), GREY, 1.8)
        ax.plot(*(0.19 * _unit(wrong)), "x", color=RED, ms=13, mew=2.6)
    ax.text(-0.25, 0.0, "outside the\ncone: left out", color=GREY, fontsize=11, va="center")
    ax.set_title("cones: [{direction, max_angle}]\nthe hand moves within max_angle of direction")


def _preset_panel(ax: Axes, preset: str, limit: float, title: str) -> None:
    half = float(np.degrees(limit))
    _object(ax)
    ways = [90.0] if preset == "top-down" else [0.0, 180.0]
    for came in ways:
        _allowed(ax, came, half)
        arrow(ax, 0.29 * _unit(came), 0.17 * _unit(came), RED, 3.6)
        arc = np.stack([_unit(angle) for angle in np.linspace(came, came + half, 20)])
        ax.plot(*(0.235 * arc).T, color=GOOD, lw=1.6)
        x, y = 0.262 * _unit(came + half / 2)
        ax.text(x, y, f"{half:.0f}°", color=GOOD, fontsize=12, ha="center", va="center")
    _hand_from(ax, ways[0])
    arrow(ax, np.array([-0.25, 0.16]), np.array([-0.25, 0.24]), EDGE, 2.2)
    ax.text(-0.25, 0.258, "up", fontsize=12, ha="center", weight="bold")
    ax.set_title(f'preset: "{preset}"\n{title}')


def _unit(angle: float) -> Float64:
    return np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])


def _allowed(ax: Axes, came: float, half: float) -> None:
    """Where hands may come from, around the object."""
    ax.add_patch(Wedge((0.0, 0.0), 0.27, came - half, came + half, fc=GOOD, alpha=0.15, zorder=0))


def _hand_from(ax: Axes, came: float) -> None:
    """A hand that came from an angle and is about to close."""
    way = -_unit(came)
    axes = np.stack([np.array([-way[1], way[0]]), way], axis=1)
    hand(ax, load_gripper("panda"), 0.06, -0.108 * way, axes, alpha=0.92)


def _object(ax: Axes) -> None:
    """A ball on a stand."""
    brown: dict[str, Any] = {"fc": OBJECT, "ec": "#9a7b2d", "lw": 1.5}
    ax.add_patch(Rectangle((-0.005, -0.1365), 0.01, 0.12, **brown))
    ax.add_patch(Ellipse((0.0, -0.132), 0.07, 0.012, **brown))
    ax.add_patch(Circle((0.0, 0.0), 0.024, **brown))
    ax.plot([-0.29, 0.29], [-0.1365, -0.1365], color="#888888", lw=3)
    ax.set(xlim=(-0.31, 0.31), ylim=(-0.145, 0.33), aspect="equal")
    ax.axis("off")


PICTURES = {
    "grippers": grippers,
    "edge_grasp": edge_grasp,
    "approach_direction": approach_direction,
}


def main(folder: Path) -> None:
    """Write every picture as PNG."""
    mpl.use("agg")
    for name, draw in PICTURES.items():
        figure = draw()
        figure.savefig(folder / f"{name}.png", dpi=90, metadata={"Software": None})
        plt.close(figure)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
