"""`edgegrasp benchmark-real`: find grasps in scenes of real cameras, judge and draw them."""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Column, Table
from typer import Option

from edgegrasp_camera.arrays import Int64
from edgegrasp_camera.picture import Picture
from edgegrasp_cli.detect import DetectorFlags, open_client
from edgegrasp_cli.flags import option_flags, parse_option_flags, takes_flags
from edgegrasp_lab.real_scenes import BEST, RealScene, SceneFigures, judge, load_scenes, renumbered
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.gripper import choose_gripper, load_gripper
from edgegrasp_model.options import parse_options
from edgegrasp_model.results import SUPPORT, UNLABELLED
from edgegrasp_sim.report import image, page, table

# Options that are set by the scene or by this command.
DECIDED = ("viewpoint", "debug", "robot", "previous")
SHARES = ("on_object", "from_below", "through_points")  # counts, reported as shares of `best`
PIXELS = ("pixel_precision", "pixel_recall")
OVERLAPS = ("overlap_precision", "overlap_recall", "overlap_f")
HEADS = (  # of the two tables; P, R and F in per cent
    ("scene", "best", "on an object %", "from below %", "through points %", "objects held", "ms"),
    ("scene", "object pixels P/R", "overlap P/R/F", "objects found", "called", "plane"),
)
ON_SUPPORT, BACKGROUND, NO_READING = (92, 112, 140), (48, 48, 52), (0, 0, 0)  # colours


@takes_flags(options=option_flags(*DECIDED))
def benchmark_real(
    scenes: Annotated[list[Path], Option(help="Folder of scenes, .npz; may be repeated.")],
    output: Annotated[
        Path, Option(help="Folder for results.json, index.html and pictures of each scene.")
    ] = Path("results/real"),
    *,
    flags: DetectorFlags,
    options: dict[str, Any],
) -> None:
    """Find grasps in scenes that real cameras saw, and judge them by the scenes' labels.

    A request contains the image and its intrinsics, or the cloud with the camera at its origin, and
    the options given as flags; nothing else about the scene.
    """
    from edgegrasp_lab.planners import model_used

    fields, loaded = parse_option_flags(options), load_scenes(scenes)
    output.mkdir(parents=True, exist_ok=True)
    done: dict[str, SceneFigures] = {}
    with open_client(flags) as client:
        model = model_used(client, fields.get("model", ""))
        own = {file.stem: load_gripper(file) for file in flags.grippers}
        gripper = choose_gripper(parse_options(fields), load_gripper(model.gripper), own)
        _ask(client, loaded[0], fields)  # loading and compiling take time
        for scene in track(loaded, "scenes", console=Console(stderr=True)):
            start = time.perf_counter()
            _ask(client, scene, fields)
            milliseconds = 1000 * (time.perf_counter() - start)
            # Not timed: sending labels can double a server's time.
            found, refused = _ask(client, scene, {**fields, "debug": True})
            seen, labels = found.support, np.full(len(scene.points), UNLABELLED)
            plane = None if seen is None else (np.asarray(seen.normal, np.float64), seen.offset)
            if found.objects:
                labels = np.asarray(found.debug.labels, np.int64)
            answer = np.maximum(labels + 1, 0)
            figures = judge(scene, found.grasps, plane, answer, gripper, milliseconds, refused)
            done[scene.name] = figures
            said = f"of the {figures.best} best {figures.on_object} on an object, plane: "
            title = f"{scene.name}: {refused or said + _plane_text(figures)}"
            draw(output / f"{scene.name}.png", scene, found.grasps[:BEST], title)
            draw_labels(output / f"{scene.name}-labels.png", scene, labels)
    _write(output, model.name, fields, done)


def _ask(client: Any, scene: RealScene, fields: Mapping[str, Any]) -> tuple[Any, str]:
    """The answer for a scene; an empty one and the reason if the request is refused."""
    from edgegrasp_client import InvalidRequestError

    try:
        return client.detect(**scene.request, **fields), ""
    except (InvalidRequest, InvalidRequestError) as error:
        return SimpleNamespace(grasps=[], support=None, objects=[]), str(error)


def _write(
    output: Path, model: str, options: Mapping[str, Any], done: dict[str, SceneFigures]
) -> None:
    """Write results.json and the page, and print the table."""
    total = summary(list(done.values()))
    scenes = {name: asdict(figures) for name, figures in done.items()}
    results = {"model": model, "options": dict(options), "all": total, "scenes": scenes}
    (output / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    rows = [_rows(name, summary([one]), _plane_text(one)) for name, one in done.items()]
    rows.append(_rows("all", total, f"{total['planes_right']} of {total['planes']} right"))
    tables = list(zip(HEADS, *rows, strict=True))
    names = [name + part for name in done for part in ("", "-labels")]
    pictures = (image("png", (output / f"{name}.png").read_bytes(), name) for name in names)
    title = f"{model} in {len(done)} scenes of real cameras"
    (output / "index.html").write_text(page(title, [*map(table, tables), *pictures]), "utf-8")
    for head, *cells in tables:
        columns = (Column(name, no_wrap=name in ("scene", "plane")) for name in head)
        shown = Table(*columns, box=None)
        for row in cells:
            shown.add_row(*row)
        Console(markup=False, emoji=False).print(shown)
    print(f"report: {output / 'index.html'}")


def summary(done: Sequence[SceneFigures]) -> dict[str, Any]:
    """Figures over all scenes; shares are of the judged grasps, None if there are none."""
    # If a heap is labelled as one object, its plane and objects are unknown.
    apart = [figures for figures in done if figures.plane_labelled]

    def share(name: str) -> float | None:
        judged = apart if name == "from_below" else done
        best = sum(figures.best for figures in judged)
        return sum(getattr(figures, name) for figures in judged) / best if best else None

    def mean(name: str, judged: Sequence[SceneFigures]) -> float | None:
        shares = [getattr(figures.segmentation, name) for figures in judged]
        return float(np.mean(shares)) if shares else None

    return {
        "scenes": len(done),
        "refused": sum(bool(figures.refused) for figures in done),
        "best": sum(figures.best for figures in done),
        **{name: share(name) for name in SHARES},
        "objects": sum(figures.objects for figures in apart),
        "objects_with_grasp": sum(figures.objects_with_grasp for figures in apart),
        **{name: mean(name, done) for name in PIXELS},
        **{name: mean(name, apart) for name in OVERLAPS},
        "instances": sum(figures.segmentation.labelled for figures in apart),
        "instances_called": sum(figures.segmentation.called for figures in apart),
        "instances_found": sum(figures.segmentation.found for figures in apart),
        "planes": len(apart),
        "planes_right": sum(figures.plane is not None and figures.plane.right for figures in apart),
        "milliseconds": float(np.median([figures.milliseconds for figures in done])),
    }


# The tables


def _rows(name: str, of: Mapping[str, Any], plane: str) -> tuple[tuple[str, ...], ...]:
    """A row of each table, from the figures over one scene or all."""
    held = f"{of['objects_with_grasp']} of {of['objects']}" if of["objects"] else "-"
    found = f"{of['instances_found']} of {of['instances']}" if of["instances"] else "-"
    called = str(of["instances_called"]) if of["instances"] else "-"
    pixels, overlap = (_shares(*(of[share] for share in shares)) for shares in (PIXELS, OVERLAPS))
    best = (_shares(of[share]) for share in SHARES)
    return (
        (name, str(of["best"]), *best, held, f"{of['milliseconds']:.0f}"),
        (name, pixels, overlap, found, called, plane),
    )


def _shares(*shares: float | None) -> str:
    """Shares as percentages."""
    return "/".join("-" if share is None else f"{100 * share:.0f}" for share in shares)


def _plane_text(figures: SceneFigures) -> str:
    plane = figures.plane
    if figures.refused:
        return "refused"
    if not figures.plane_labelled:
        return "-"
    if plane is None:
        return "none found"
    verdict = "right" if plane.right else "wrong"
    return f"{verdict}: {plane.angle:.1f}°, {1000 * plane.offset:.0f} mm"


# Pictures


def draw(path: Path, scene: RealScene, grasps: Sequence[Any], title: str) -> None:
    """Write a picture: the camera's image with the labelled objects' outlines and the grasps.

    Grasps are best first, in the camera's frame.
    """
    picture = Picture(scene.camera, scene.points, image=scene.rgb, title=title)
    row = picture.row_of_pixel
    for label in scene.objects:
        picture.outline((row >= 0) & (scene.labels[row] == label))
    picture.grasps(grasps)
    picture.save(path)


def draw_labels(path: Path, scene: RealScene, labels: Int64) -> None:
    """Write three pictures side by side: the camera's image, its labels, the detector's (R,).

    Support and obstacles are grey, objects coloured; a labelled object and the detected one that
    matches it best have the same colour.
    """
    from matplotlib import colormaps
    from matplotlib.image import imsave

    truth, paints = scene.object_of_point, colormaps["tab20"](np.arange(20))[:, :3]
    found = renumbered(truth, np.maximum(labels + 1, 0))
    row = scene.camera.rows_of_pixels(scene.points)

    def painted(number: Int64, support: Any) -> Any:
        color = 255 * paints[(2 * number - 2 + (number > 10)) % len(paints)]
        color[number == 0] = BACKGROUND
        color[(number == 0) & support] = ON_SUPPORT
        return np.where((row >= 0)[..., None], color[row], NO_READING)

    depth = np.where(row >= 0, scene.camera.project(scene.points)[1][row], np.nan)
    image = scene.rgb
    if image is None:
        near, far = np.nanpercentile(depth, (1, 95))
        image = 255 * colormaps["gray"](1 - (depth - near) / (far - near))[..., :3]
    parts = [image, painted(truth, scene.labels == 1), painted(found, labels == SUPPORT)]
    imsave(path, np.hstack(parts).astype(np.uint8))
