"""Draws grippers.png, of the gripper files: `python docs/make_pictures.py [folder]`."""

import sys
from pathlib import Path

import matplotlib as mpl
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from edgegrasp_model.gripper import Gripper, gripper_names, load_gripper

PICTURE = "grippers.png"
X, Y, Z = "#c0392b", "#1e8449", "#1f4e9c"  # colours of the axes
HAND, FINGER, EDGE, GREY = "#e4e7ec", "#c5ccd6", "#444444", "#666666"
LABEL_STEP = 0.0135  # metres between the heights' labels at least


def main(folder: Path) -> None:
    """Draw every gripper that ships: boxes, hand frame, TCP frame and heights along z."""
    mpl.use("agg")
    shown = sorted((load_gripper(name) for name in gripper_names()), key=lambda g: g.max_tip_z)
    rows = [shown[start : start + 2] for start in range(0, len(shown), 2)]
    depths = [max(gripper.max_tip_z for gripper in row) + 0.07 for row in rows]
    figure, panels = plt.subplots(
        len(rows),
        2,
        figsize=(11, 16.2 * (sum(depths) + 0.06 * len(rows)) + 0.6),
        layout="constrained",
        height_ratios=[depth + 0.06 for depth in depths],
        squeeze=False,
    )
    for row, axes, depth in zip(rows, panels, depths, strict=True):
        for ax, gripper in zip(axes, row, strict=False):
            draw_gripper(ax, gripper)
            ax.set(xlim=(-0.125, 0.215), ylim=(-depth, 0.06), aspect="equal")
        for ax in axes:
            ax.axis("off")
    figure.suptitle(
        "Hand frame and TCP frame of each gripper, seen from the front: x points into the page.\n"
        "Fingers fully open; dotted: their tips closed. Heights are metres along the hand's z.",
        fontsize=12,
    )
    figure.savefig(folder / PICTURE, dpi=90, metadata={"Software": None})
    plt.close(figure)


def draw_gripper(ax: Axes, gripper: Gripper) -> None:
    """A gripper seen along its x; the picture's axes are the hand's y and -z, metres."""
    hands = len(gripper.hand_boxes)
    for number, (low, high) in enumerate(gripper.boxes(gripper.max_opening)[:, :, 1:]):
        color = HAND if number < hands else FINGER
        ax.add_patch(Rectangle((low[0], -high[1]), *(high - low), fc=color, ec=EDGE, lw=1.0))
    closed = gripper.boxes(0.0)[hands:, :, 1:]
    for low, high in closed[closed[:, 1, 1] > closed[:, 1, 1].max() - 1e-6]:
        corner = (low[0], -high[1])
        ax.add_patch(Rectangle(corner, *(high - low), fill=False, ec=GREY, ls=":", lw=1.1))
    draw_frame(ax, "hand", 0.0, 0.03)
    draw_frame(ax, "TCP", gripper.tcp_z, 0.02)
    draw_heights(ax, gripper)
    half, below = gripper.max_opening / 2, -gripper.max_tip_z - 0.042
    style = {"arrowstyle": "<|-|>", "color": GREY, "mutation_scale": 9, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", (half, below), (-half, below), arrowprops=style)
    text = f"max_opening {gripper.max_opening:g}"
    ax.text(0, below - 0.010, text, color=GREY, ha="center", va="center", fontsize=10)
    ax.vlines((-half, half), below, -gripper.tip_z, color=GREY, lw=0.6)
    ax.text(-0.12, 0.045, gripper.name, weight="bold", fontsize=13, va="center")


def draw_frame(ax: Axes, name: str, z: float, length: float) -> None:
    """A frame's y and z axes, and a crossed circle for x, which points into the page."""
    style = {"arrowstyle": "-|>", "lw": 2.2, "mutation_scale": 14, "shrinkA": 0, "shrinkB": 0}
    for color, label, right, down in ((Y, "y", length, 0.0), (Z, "z", 0.0, length)):
        ax.annotate("", (right, -z - down), (0.0, -z), arrowprops={**style, "color": color})
        at = (1.18 * right, -z - 1.18 * down)
        ax.text(*at, label, color=color, ha="center", va="center", weight="bold", fontsize=11)
    ax.plot(0.0, -z, "o", ms=9, mfc="white", mec=X, mew=1.8, zorder=5)
    ax.plot(0.0, -z, "x", ms=5, color=X, mew=1.5, zorder=6)
    backing = {"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1.0}
    label = {"ha": "right", "va": "center", "weight": "bold", "fontsize": 10, "zorder": 6}
    ax.text(-0.525 * length, -z, name, bbox=backing, **label)


def draw_heights(ax: Axes, gripper: Gripper) -> None:
    """Ticks at heights along z with labels that do not overlap."""
    named = {
        "hand frame": 0.0,
        "palm": gripper.palm_z,
        "contact": gripper.contact_z,
        "fingertips": gripper.tip_z,
        "TCP": gripper.tcp_z,
    }
    if gripper.linkage is not None:
        named["fingertips, closed"] = gripper.tip_z + float(gripper.tip_advance(0.0))
    heights = sorted({round(height, 4) for height in named.values()})
    line, at = 0.118, 1.0
    for height in heights:
        labels = [label for label, value in named.items() if round(value, 4) == height]
        at = min(-height, at - LABEL_STEP)
        ax.plot([line, line + 0.006, line + 0.012], [-height, -height, at], color=GREY, lw=0.9)
        ax.text(line + 0.014, at, f"{height:g}  {', '.join(labels)}", va="center", fontsize=9.5)
    ax.plot([line, line], [-heights[0], -heights[-1]], color=GREY, lw=0.9)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
