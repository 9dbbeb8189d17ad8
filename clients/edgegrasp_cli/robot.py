"""The command `robot`: make a robot file from a URDF, and check one."""

import importlib
import json
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option, Typer

from edgegrasp_model.errors import EdgeGraspError

robot = Typer(help="Make and check robot files.", no_args_is_help=True, add_completion=False)

NO_OFFSET = """
[T_flange_hand]
position = [0.0, 0.0, 0.0]
quaternion = [0.0, 0.0, 0.0, 1.0]
"""
FIELDS_TO_EDIT = ("home", "max_velocity", "max_acceleration")  # not set by `add`
Links = Annotated[str, Option(help="Link of the URDF.")]


@robot.command()
def add(
    urdf: Annotated[Path, Argument(help="URDF or xacro of the arm.")],
    base: Links,
    flange: Links,
    output: Annotated[Path, Option(help="Robot file to write, .toml.")],
    gripper: Annotated[str, Option(help="Name of a built-in gripper, or a file.")] = "panda",
    srdf: Annotated[str, Option(help="SRDF with pairs of links that may touch.")] = "",
    packages: Annotated[list[str] | None, Option(help="Folder that contains packages.")] = None,
) -> None:
    """Write a robot file for an arm's URDF, and check it.

    edgegrasp robot add my.urdf --base base_link --flange tool0 --output my.toml
    """
    importlib.import_module("edgegrasp_robot")  # fails before the file is written
    if output.suffix != ".toml" or output.exists() or not output.parent.is_dir():
        fix = "Name a new file, .toml, in a folder that exists."
        raise ValueError(f"--output: got {str(output)!r}. {fix}")
    fields: dict[str, Any] = {
        "urdf": str(urdf.absolute()),
        "srdf": str(Path(srdf).absolute()) if srdf else "",
        "packages": [str(Path(folder).absolute()) for folder in packages or ()],
        "base_frame": base,
        "flange_frame": flange,
        "gripper": str(Path(gripper).absolute()) if gripper.endswith(".toml") else gripper,
    }
    lines = [f"{name} = {json.dumps(value)}\n" for name, value in fields.items()]
    output.write_text("".join([*lines, NO_OFFSET]), "utf-8")
    try:
        check(output)
    except EdgeGraspError as error:
        if getattr(error.__cause__, "field", "") not in FIELDS_TO_EDIT:
            output.unlink()  # it needs other arguments, not an edit
        raise
    finally:
        if output.exists():
            print(f"{output}: now set T_flange_hand, and {', '.join(FIELDS_TO_EDIT)} if needed.")


@robot.command()
def check(
    file: Annotated[Path, Argument(help="Robot file, .toml, or the name of a built-in robot.")],
    picture: Annotated[Path | None, Option(help="PNG to write: the arm at home.")] = None,
) -> None:
    """Load a robot file, print its facts, and draw the arm in its home position.

    edgegrasp robot check fr3 --picture fr3.png
    """
    from edgegrasp_robot import load_robot

    found = load_robot(file)
    for name, value in found.describe().items():
        if name not in ("frames", "axes", "sliding"):  # long, for programs that draw the arm
            print(f"{name}: {value}")
    hand = found.forward_kinematics(found.home)
    x, y, z = hand[:3, 3]
    print(f"hand at home: {x:.3f} {y:.3f} {z:.3f} m from {found.base_frame}")
    if picture is None:
        return
    # The links as a line, and the hand's axes: x red, y green (closing), z blue.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 6), dpi=100)
    axes = figure.add_subplot(projection="3d")
    poses = [
        found.scene.forwardKinematics(found.home, link, found.base_frame)
        for link in found.model.links
    ]
    axes.plot(*zip(*(pose[:3, 3] for pose in poses), strict=True), "o-", color="0.3", linewidth=4)
    for axis, color in zip(hand[:3, :3].T, ("red", "green", "blue"), strict=True):
        axes.plot(*zip(hand[:3, 3], hand[:3, 3] + 0.15 * axis, strict=True), color=color)
    axes.set(xlabel="x", ylabel="y", zlabel="z", title=f"{found.name} at home")
    axes.set_aspect("equal")
    figure.savefig(picture)
