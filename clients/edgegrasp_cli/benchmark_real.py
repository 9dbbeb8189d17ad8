"""`edgegrasp benchmark-real`: grasps in scenes of real cameras, judged by labels, and drawn."""

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from edgegrasp_cli.detect import Device, Grippers, Weights, open_client
from edgegrasp_cli.flags import (
    CONNECTION,
    Server,
    Timeout,
    option_flags,
    parse_option_flags,
    takes_flags,
)

if TYPE_CHECKING:
    from edgegrasp_cli.real_scenes import PlaneFigures, RealScene, SceneFigures
    from edgegrasp_model.gripper import Gripper
    from edgegrasp_sim.picture import Picture

Option = typer.Option
DECIDED = ("viewpoint",)  # options that the scene decides
PLANE_SQUARE = 0.12  # metres, edge of the square that shows a plane at an object's foot
LABELLED, FOUND = "#39d353", "#ff4fd8"  # colours of the planes
CAPTION = "\nwhite: labelled objects    green: labelled plane    pink: the plane found"


@takes_flags(connection=CONNECTION, options=option_flags(*DECIDED))
def benchmark_real(
    scenes: Annotated[Path, Option(help="Folder of scenes, .npz; docs/benchmark.md: format.")],
    output: Annotated[
        Path, Option(help="Folder for results.json, index.html and a picture of each scene.")
    ] = Path("results/real"),
    server: Server = None,
    timeout: Timeout = 60.0,
    weights: Weights = None,
    grippers: Grippers = None,
    device: Device = "cpu",
    *,
    connection: dict[str, Any],
    options: dict[str, Any],
) -> None:
    """Find grasps in scenes that real cameras saw, and judge them by the scenes' labels.

    A request holds the image and its intrinsics, or the cloud and that the camera is at its
    origin, and the options given as flags; nothing else is said about a scene.
    """
    from rich.console import Console
    from rich.progress import track

    from edgegrasp_cli.real_scenes import BEST, judge, load_scenes

    fields, loaded = parse_option_flags(options), load_scenes(scenes)
    output.mkdir(parents=True, exist_ok=True)
    done: dict[str, SceneFigures] = {}
    model = ""
    with open_client(server, timeout, connection, weights, grippers, device) as client:
        client.detect(**loaded[0].request, **fields)  # what is loaded or compiled first takes time
        for scene in track(loaded, "scenes", console=Console(stderr=True)):
            start = time.perf_counter()
            detection = client.detect(**scene.request, **fields)
            milliseconds = 1000 * (time.perf_counter() - start)
            model = detection.model
            gripper = _gripper(client, model, grippers, fields)
            plane = _plane(detection)
            done[scene.name] = judge(scene, detection.grasps, plane, gripper, milliseconds)
            title = f"{scene.name}: {_sentence(done[scene.name])}"
            draw(output / f"{scene.name}.png", scene, detection.grasps[:BEST], plane, title)
    _write(output, model, fields, done)


def _gripper(
    client: Any, model: str, files: Sequence[Path] | None, options: Mapping[str, Any]
) -> "Gripper":
    """The hand that a request with these options is answered for."""
    from edgegrasp_model.gripper import choose_gripper, load_gripper
    from edgegrasp_model.options import parse_options

    own = {file.stem: load_gripper(file) for file in files or ()}
    name = next(row.gripper for row in client.models() if row.name == model)
    return choose_gripper(parse_options(options), load_gripper(name), own)


def _plane(detection: Any) -> tuple[Any, float] | None:
    """Normal (3,) and offset of the support plane that was found, camera frame."""
    found = detection.support
    return None if found is None else (np.asarray(found.normal, dtype=np.float64), found.offset)


def _write(
    output: Path, model: str, options: Mapping[str, Any], done: "dict[str, SceneFigures]"
) -> None:
    """Write results.json and the page, and print the table."""
    from rich.console import Console
    from rich.table import Table

    from edgegrasp_sim.page import image, page, table

    total = summary(list(done.values()))
    scenes = {name: figures.document() for name, figures in done.items()}
    results = {"model": model, "options": dict(options), "all": total, "scenes": scenes}
    (output / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    rows = [HEAD, *(_row(name, figures) for name, figures in done.items()), _total_row(total)]
    pictures = (image("png", (output / f"{name}.png").read_bytes(), name) for name in done)
    title = f"{model} in {len(done)} scenes of real cameras"
    (output / "index.html").write_text(page(title, [table(rows), *pictures]))
    shown = Table(*HEAD, box=None)
    for column in shown.columns:
        column.no_wrap = column.header in ("scene", "plane")
    for row in rows[1:]:
        shown.add_row(*row)
    Console().print(shown)
    print(f"report: {output / 'index.html'}")


def summary(done: "Sequence[SceneFigures]") -> dict[str, Any]:
    """Figures over all scenes; shares are of the grasps judged, None where there are none."""
    best = sum(figures.best for figures in done)

    def share(name: str) -> float | None:
        return sum(getattr(figures, name) for figures in done) / best if best else None

    return {
        "scenes": len(done),
        "best": best,
        **{name: share(name) for name in ("on_object", "from_below", "through_points")},
        "objects": sum(figures.objects for figures in done),
        "objects_with_grasp": sum(figures.objects_with_grasp for figures in done),
        "planes_right": sum(figures.plane is not None and figures.plane.right for figures in done),
        "milliseconds": float(np.median([figures.milliseconds for figures in done])),
    }


# The table

HEAD = (
    "scene",
    "best",
    "on an object",
    "from below",
    "through points",
    "objects with a grasp",
    "plane",
    "ms",
)


def _row(name: str, figures: "SceneFigures") -> tuple[str, ...]:
    counts = (figures.best, figures.on_object, figures.from_below, figures.through_points)
    found = f"{figures.objects_with_grasp} of {figures.objects}"
    return name, *map(str, counts), found, _plane_text(figures.plane), f"{figures.milliseconds:.0f}"


def _total_row(total: Mapping[str, Any]) -> tuple[str, ...]:
    shares = (total[name] for name in ("on_object", "from_below", "through_points"))
    texts = ("-" if share is None else f"{100 * share:.0f} %" for share in shares)
    found = f"{total['objects_with_grasp']} of {total['objects']}"
    planes = f"{total['planes_right']} of {total['scenes']} right"
    return "all", str(total["best"]), *texts, found, planes, f"{total['milliseconds']:.0f}"


def _plane_text(plane: "PlaneFigures | None") -> str:
    if plane is None:
        return "none found"
    verdict = "right" if plane.right else "wrong"
    return f"{verdict}: {plane.angle:.1f}°, {1000 * plane.offset:.0f} mm"


def _sentence(figures: "SceneFigures") -> str:
    return (
        f"of the {figures.best} best {figures.on_object} on an object, {figures.from_below} from "
        f"below, {figures.through_points} through points; plane {_plane_text(figures.plane)}"
    )


# Pictures


def draw(
    path: Path,
    scene: "RealScene",
    grasps: Sequence[Any],
    plane: tuple[Any, float] | None,
    title: str,
) -> None:
    """Write a picture: the camera's image with the grasps, and both support planes.

    Grasps are best first and the plane that was found is its normal (3,) and offset, both in the
    camera's frame.
    """
    from edgegrasp_sim.picture import Picture

    picture = Picture(scene.camera, scene.points, image=scene.rgb, title=title + CAPTION)
    row = picture.row_of_pixel
    for label in scene.objects:
        picture.outline((row >= 0) & (scene.labels[row] == label))
    _draw_plane(picture, scene, scene.normal, scene.offset, LABELLED, width=3.5)
    if plane is not None:
        _draw_plane(picture, scene, *plane, FOUND, width=1.4)
    picture.grasps(grasps)
    picture.save(path)


def _draw_plane(
    picture: "Picture", scene: "RealScene", normal: Any, offset: float, color: str, *, width: float
) -> None:
    """A square of a plane at the foot of each object, and the way up from it."""
    across = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [1.0, 0.0, 0.0])
    across = across / np.linalg.norm(across)
    half = PLANE_SQUARE / 2 * np.stack([across, np.cross(normal, across)])
    for foot in scene.feet:
        middle = foot - (foot @ normal - offset) * normal
        around = [(1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1)]
        for line in (middle + around @ half, [middle, middle + PLANE_SQUARE / 2 * normal]):
            picture.lines(line, color, width)
