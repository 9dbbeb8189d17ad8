"""The logic of the node, without ROS: messages to a request, grasps to the fields of messages.

Incoming messages are any objects with the same attributes; outgoing messages are dictionaries of
fields, for `rosidl_runtime_py.set_message_fields`. Poses are poses of the hand's frame, except for
`moveit_msgs/Grasp`, which has the end effector's parent link.
"""

from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from edgegrasp_camera.arrays import Array, Float64
from edgegrasp_camera.clouds import read_point_cloud2
from edgegrasp_camera.depth import DepthView, fuse_depth_images, to_intrinsics
from edgegrasp_camera.picture import fork
from edgegrasp_client import GraspClient, GraspClientError, GraspTracker, Robot, conversions
from edgegrasp_client.conversions import Message, pose_fields, xyz_fields
from edgegrasp_client.options import DetectOptions
from edgegrasp_client.requests import object_in_scene, on_mask, option_of_text
from edgegrasp_results import Detection

Lookup = Callable[[str, str, Any], Float64]
"""lookup(target, source, stamp): T_target_source (4, 4), from tf2; stamp None: the latest."""

OPTION_PREFIX = "options."  # prefix of the parameters that are options of a detection
DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")  # encodings of depths: millimetres, or metres
ENCODINGS = {  # of sensor_msgs/Image: type of a value, channels
    **dict.fromkeys(("mono8", "8UC1"), ("u1", 1)),
    **dict.fromkeys(("rgb8", "bgr8", "8UC3"), ("u1", 3)),
    **dict.fromkeys(("rgba8", "bgra8", "8UC4"), ("u1", 4)),
    **dict.fromkeys(("mono16", "16UC1"), ("u2", 1)),
    "32SC1": ("i4", 1),
    "32FC1": ("f4", 1),
}
DELETE_ALL, LINE_LIST = 3, 5  # of visualization_msgs/Marker
LINE_WIDTH = 0.003  # metres
KEPT_MESSAGES = 30  # latest images or clouds, for which a mask may still arrive
MAX_BEHIND = 5.0  # seconds; older images of another camera are not used together with an image


@dataclass(frozen=True)
class Settings:
    """The node's parameters, without the options; each field is a parameter with its default."""

    server: str = "127.0.0.1:50051"  # host:port (gRPC) or http://host:port
    timeout: float = 30.0  # seconds for a request
    on_message: bool = True  # detect for every cloud, image or mask, not only for an action
    follow: bool = False  # follow a grasp from message to message; the camera must not move
    mask_age: float = 1.0  # seconds a mask may be behind the newest image; 0: masks are not used
    target_frame: str = ""  # frame of the answers; empty: the frame of the cloud or image
    camera_frame: str = ""  # frame of a cloud's camera; empty: the camera is at the cloud's origin
    gravity_frame: str = ""  # its z is up; empty: target_frame; "none": found from the support
    hand_frame: str = ""  # the gripper's hand frame, such as panda_hand; used with parent_link
    parent_link: str = ""  # of the end effector, such as panda_link8; empty: the hand frame
    joint_names: tuple[str, ...] = conversions.PANDA_JOINTS.names
    joint_closed: float = 0.0  # position of each joint in the closed hand
    joint_per_metre: float = 0.5  # motion of each joint per metre of opening
    approach_distance: float = 0.05  # metres of straight approach from the pregrasp pose
    retreat_distance: float = 0.1  # metres of straight retreat, back along the approach

    @property
    def joints(self) -> conversions.FingerJoints:
        """The gripper's joints."""
        closed, names = self.joint_closed, self.joint_names
        return conversions.FingerJoints(
            names, lambda opening: (closed + self.joint_per_metre * opening,) * len(names)
        )


def parameters() -> dict[str, Any]:
    """Names and defaults of the node's parameters; empty text for an option: server's default."""
    own = {each.name: each.default for each in fields(Settings)}
    own["joint_names"] = list(Settings.joint_names)
    return own | {f"{OPTION_PREFIX}{name}": "" for name in DetectOptions.__annotations__}


def read_parameters(given: Mapping[str, Any]) -> tuple[Settings, dict[str, Any]]:
    """Settings, and options of a detection; an option's text is parsed if it is valid JSON."""
    options = {}
    for name, value in given.items():
        if name.startswith(OPTION_PREFIX) and not (isinstance(value, str) and value == ""):
            options[name.removeprefix(OPTION_PREFIX)] = option_of_text(value)
    if options.get("objects") is False:  # YAML reads `off` as False
        options["objects"] = "off"
    return Settings(**{each.name: given[each.name] for each in fields(Settings)}), options


class Scene(NamedTuple):
    """The input of a detection: a cloud, or a depth image with its camera, and perhaps a mask."""

    cloud: Any = None  # sensor_msgs/PointCloud2
    depth: Any = None  # sensor_msgs/Image, rectified
    camera: Any = None  # sensor_msgs/CameraInfo of `depth`
    mask: Any = None  # sensor_msgs/Image: not 0 on the object to grasp
    others: tuple[tuple[Any, Any], ...] = ()  # further depth images and their cameras
    joints: Mapping[str, float] = {}  # the latest position of each joint, by its name

    @property
    def header(self) -> Any:
        """The header of the message that the points come from; None before the first one."""
        return getattr(self.depth if self.cloud is None else self.cloud, "header", None)


class Inbox:
    """Keeps the latest messages, and matches those that belong together."""

    def __init__(self) -> None:
        self._sources = {field: deque[Any](maxlen=KEPT_MESSAGES) for field in ("cloud", "depth")}
        self._cameras: dict[str, Any] = {}  # by their frames
        self._newest: dict[str, Any] = {}  # depth images, by their frames
        self._mask: Any = None
        self._joints: dict[str, float] = {}

    def take(self, field: str, message: Any, mask_age: float) -> bool:
        """Keep a message of a field of Scene; returns whether there is new input to detect in."""
        new = field in self._sources
        if field == "camera":  # the first CameraInfo may arrive after its image
            new = message.header.frame_id not in self._cameras and len(self._newest) > 0
            self._cameras[message.header.frame_id] = message
        elif field == "mask":
            self._mask = message
        elif field == "joints":  # an arm and a gripper may publish separately
            self._joints |= zip(message.name, map(float, message.position), strict=False)
        else:
            self._sources[field].append(message)
            if field == "depth":
                self._newest[message.header.frame_id] = message
        masked = self._mask is not None and mask_age > 0 and field != "camera"
        return self._mask_is_due(field, message, mask_age) if masked else new

    def _mask_is_due(self, field: str, message: Any, mask_age: float) -> bool:
        """Whether a message completes a mask and its image, or shows that none will match."""
        sources = next(filter(None, map(list, self._sources.values())), [])
        if field not in ("mask", *self._sources) or not sources:
            return field == "mask"
        its = self._mask.header.stamp
        age = _seconds(sources[-1].header.stamp, its)
        if age < 0 or field == "mask":  # a mask newer than the newest image waits for its image
            return age >= 0
        known = any(each.header.stamp == its for each in sources)
        return message.header.stamp == its or not known or age > mask_age

    def scene(self, mask_age: float) -> Scene:
        """The newest cloud or depth image of each camera; with a mask, the image of the mask.

        Raises:
            ValueError: The mask is too old, or its image has not arrived.
        """
        clouds, depths = map(list, self._sources.values())  # copies: messages may arrive meanwhile
        sources = clouds or depths
        if not sources:
            return Scene(joints=self._joints)
        source, mask = sources[-1], self._mask if mask_age > 0 else None
        if mask is not None:
            its = mask.header.stamp
            if (age := _seconds(source.header.stamp, its)) > mask_age:
                why = f"The mask is {age:.3g} s older than the newest image"
                raise ValueError(f"{why}. Send masks, or set mask_age: {mask_age:g} s.")
            same = [each for each in sources if each.header.stamp == its]
            if not same:
                raise ValueError("No image has the stamp of the mask. Copy the image's header.")
            source = max(same, key=lambda each: each.header.frame_id == mask.header.frame_id)
        if clouds:
            return Scene(cloud=source, mask=mask, joints=self._joints)
        latest = [source]
        if mask is None:
            # The first image's frame is the frame of the answer, which must not change.
            now, newest = source.header.stamp, sorted(self._newest.copy().items())
            latest = [it for _, it in newest if abs(_seconds(now, it.header.stamp)) <= MAX_BEHIND]
        source, *more = latest
        others = tuple((each, self._camera_of(each)) for each in more)
        return Scene(None, source, self._camera_of(source), mask, others, self._joints)

    def _camera_of(self, depth: Any) -> Any:
        """The CameraInfo with an image's frame, or the only one if there is only one camera."""
        frames = {each.header.frame_id for each in list(self._sources["depth"])}
        alone = len(self._cameras) == len(frames) == 1
        only = next(iter(self._cameras.values())) if alone else None
        return self._cameras.get(depth.header.frame_id, only)


def _seconds(late: Any, early: Any) -> float:
    """Seconds from one stamp to another."""
    return float(late.sec - early.sec + 1e-9 * (late.nanosec - early.nanosec))


@dataclass(frozen=True, eq=False, kw_only=True)
class Found(Detection):
    """A detection whose grasps' T_cloud_hand and approach_direction are in the header's frame."""

    header: Message  # std_msgs/Header


def detect(
    client: GraspClient,
    scene: Scene,
    settings: Settings,
    options: Mapping[str, Any],
    lookup: Lookup,
    object_cloud: Any = None,
    tracker: GraspTracker | None = None,
) -> Found:
    """Grasps of a scene, or of one object in it.

    Args:
        client: A client of the server.
        scene: The latest messages.
        settings: The node's parameters.
        options: Options of the detection; they override options derived from frames.
        lookup: Transforms between frames.
        object_cloud: sensor_msgs/PointCloud2 of the object to grasp.
        tracker: A tracker made with `options`, which follows its grasp.

    Raises:
        GraspClientError: The server is unavailable or refuses the request.
        ValueError: No cloud or image has arrived, or a message cannot be read.
        InvalidRequest: A cloud or an image does not match its fields.
    """
    if scene.header is None and object_cloud is not None:
        scene, object_cloud = scene._replace(cloud=object_cloud), None
    if scene.header is None:
        raise ValueError("No cloud and no depth image has arrived yet.")
    frame_id, stamp = scene.header.frame_id, scene.header.stamp
    asked = _from_frames(scene, settings, lookup) | dict(tracker.options() if tracker else options)
    if scene.mask is not None and object_cloud is None:
        asked = dict(on_mask(image_array(scene.mask), asked))
    if asked.get("robot"):
        asked["robot"] = _robot(client, asked["robot"], scene, lookup)
    cloud = scene.cloud
    if object_cloud is not None:
        T = _pose_at(object_cloud.header, scene, settings, lookup)
        wanted = _points(Scene(cloud=object_cloud), settings, lookup) @ T[:3, :3].T + T[:3, 3]
        cloud, asked["segment_ids"] = object_in_scene(wanted, _points(scene, settings, lookup))
        asked.setdefault("viewpoint", [0.0, 0.0, 0.0])
    elif cloud is None:
        asked["depth_images"] = _depth_images(scene, settings, lookup)
    try:
        found = client.detect(cloud, **asked)
    except GraspClientError:  # the server's robots may have changed
        _robots.cache_clear()
        raise
    if tracker is not None:
        tracker.take(found)
    target, grasps = settings.target_frame or frame_id, []
    T_target_cloud = lookup(target, frame_id, stamp)
    for grasp in found.grasps:
        pose = (T_target_cloud @ grasp.T_cloud_hand).astype(np.float32)
        grasps.append(replace(grasp, T_cloud_hand=pose, approach_direction=pose[:3, 2]))
    header = {"stamp": {"sec": stamp.sec, "nanosec": stamp.nanosec}, "frame_id": target}
    return Found(**vars(found) | {"grasps": grasps}, header=header)


def pose_array(found: Found, back: float = 0.0) -> Message:
    """geometry_msgs/PoseArray of the hand's frame, best first; `back`: metres before the grasp."""
    poses = [pose_fields(each.pregrasp(back)) for each in found.grasps]
    return {"header": found.header, "poses": poses}


def marker_array(found: Found) -> Message:
    """visualization_msgs/MarkerArray: a fork for each grasp, red to green by its score."""
    markers: list[Message] = [{"header": found.header, "action": DELETE_ALL}]
    palm_and_tip = found.gripper.palm_z, found.gripper.tip_z
    for number, grasp in enumerate(found.grasps):
        pieces = fork(grasp.T_cloud_hand, grasp.width, palm_and_tip)
        score = float(grasp.score)
        marker = {
            "header": found.header,
            "ns": "grasps",
            "id": number,
            "type": LINE_LIST,
            "scale": {"x": LINE_WIDTH},
            "color": {"r": 1.0 - score, "g": score, "a": 1.0},
            "points": [xyz_fields(end) for end in pieces.reshape(-1, 3)],
        }
        markers.append(marker)
    return {"markers": markers}


def trajectories(found: Found) -> list[Message]:
    """The motions of the best pick, as trajectory_msgs/JointTrajectory; empty without a motion."""
    pick = found.best_pick
    motion = pick and pick.arm and pick.arm.trajectory
    return conversions.joint_trajectories(motion) if motion else []


def moveit_grasps(found: Found, settings: Settings, lookup: Lookup) -> Message:
    """Result and feedback of grasping_msgs/GraspPlanning: poses of the end effector's parent."""
    link = settings.parent_link
    T_hand_link = lookup(settings.hand_frame or link, link, None) if link else None
    grasps = [
        conversions.moveit_grasp(
            grasp,
            found.header["frame_id"],
            name=f"grasp_{number}",
            stamp=found.header["stamp"],
            joints=settings.joints,
            T_hand_link=T_hand_link,
            approach_distance=settings.approach_distance,
            retreat_distance=settings.retreat_distance,
        )
        for number, grasp in enumerate(found.grasps)
    ]
    return {"grasps": grasps}


def object_results(found: Found, settings: Settings, object_id: str = "", most: int = 0) -> Message:
    """Result of GenerateGrasps: at most `most` grasps of each object; 0: all.

    `object_id` names the object whose cloud was sent; empty: all objects, named by their numbers.
    """
    groups = {
        str(thing.number): [each for each in found.grasps if each.object == thing.number]
        for thing in found.objects
    }
    if object_id or not groups:
        groups = {object_id: found.grasps}
    stages = ", ".join(f"{count} {stage}" for stage, count in found.counts.items())
    why = " ".join([f"No grasp: {stages}.", *found.warnings])
    results: list[Message] = []
    for name, grasps in groups.items():
        candidates = [
            {
                "pose": {"header": found.header, "pose": pose_fields(grasp.T_cloud_hand)},
                "confidence": min(max(float(grasp.score), 0.0), 1.0),
                "width": float(grasp.width),
                "pregrasp": pose_fields(grasp.pregrasp(settings.approach_distance)),
                "retreat": pose_fields(grasp.retreat(settings.retreat_distance)),
            }
            for grasp in (grasps[:most] if most else grasps)
        ]
        said = {"success": bool(candidates), "message": "" if candidates else why}
        results.append({"object_id": name, **said, "candidates": candidates})
    return {"results": results}


def failed_result(object_id: str, why: Exception) -> Message:
    """Result of GenerateGrasps for an aborted goal."""
    message = f"{type(why).__name__}: {why}"
    return {"results": [{"object_id": object_id, "success": False, "message": message}]}


def image_array(image: Any, known: Collection[str] = ENCODINGS) -> Array:
    """The values (H, W) or (H, W, C) of a sensor_msgs/Image; ValueError for an unknown encoding."""
    if image.encoding not in known:
        value = f"{image.encoding!r} for this image"
        raise ValueError(f"encoding: got {value}. Send one of {', '.join(known)}.")
    kind, channels = ENCODINGS[image.encoding]
    dtype = np.dtype(f"{'>' if image.is_bigendian else '<'}{kind}")
    rows = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
    used = np.ascontiguousarray(rows[:, : image.width * channels * dtype.itemsize])
    values = used.view(dtype).astype(dtype.newbyteorder("="))
    return values if channels == 1 else values.reshape(image.height, image.width, channels)


def camera_matrix(camera: Any) -> Float64:
    """The (3, 3) matrix of a rectified image, cropped and binned, from `p`, or `k` if `p` is 0.

    Raises ValueError if no CameraInfo has arrived, or its camera is not calibrated.
    """
    if camera is None:
        raise ValueError("The depth image has no CameraInfo yet.")
    projection = np.asarray(camera.p, np.float64).reshape(3, 4)[:, :3]
    matrix = projection if projection[0, 0] else np.asarray(camera.k, np.float64).reshape(3, 3)
    if not matrix[0, 0]:
        raise ValueError("camera_info: p and k are 0. Calibrate the camera.")
    cut = matrix - [[0, 0, camera.roi.x_offset], [0, 0, camera.roi.y_offset], [0, 0, 0]]
    return np.asarray(cut / [[max(camera.binning_x, 1)], [max(camera.binning_y, 1)], [1]])


def matrix_from_transform(transform: Any) -> Float64:
    """The (4, 4) matrix of a geometry_msgs/Transform."""
    turn, shift = transform.rotation, transform.translation
    T = np.eye(4)
    T[:3, :3] = conversions.matrix_from_quaternion([turn.x, turn.y, turn.z, turn.w])
    T[:3, 3] = shift.x, shift.y, shift.z
    return T


@lru_cache(1)  # not asked again for every image
def _robots(client: GraspClient) -> dict[str, Robot]:
    return {robot.name: robot for robot in client.robots()}


def _robot(
    client: GraspClient, asked: str | Mapping[str, Any], scene: Scene, lookup: Lookup
) -> dict[str, Any]:
    """The option `robot`, given as a name or a mapping, with the arm's joints and pose."""
    given = {"name": asked} if isinstance(asked, str) else asked
    name, listed = given.get("name"), _robots(client)
    if (robot := listed.get(str(name))) is None:
        _robots.cache_clear()
        known = ", ".join(listed) or "none: set its setting `robots`"
        raise ValueError(f"options.robot: got {name!r}. The server's robots are {known}.")
    joints = [scene.joints.get(name) for name in robot.joint_names]
    if None in joints and "joints" not in given:
        missing = robot.joint_names[joints.index(None)]
        raise ValueError(f"joint_states: no position of {missing!r} has arrived.")
    if "T_base_cloud" in given:
        return {"joints": joints, **given}
    T_base_cloud = lookup(robot.base_frame, scene.header.frame_id, scene.header.stamp)
    return {"joints": joints, "T_base_cloud": T_base_cloud.ravel().tolist(), **given}


def _pose_at(header: Any, scene: Scene, settings: Settings, lookup: Lookup) -> Float64:
    """T_scene_frame (4, 4) of a header's frame, each frame at the time of its message."""
    level = "" if settings.gravity_frame == "none" else settings.gravity_frame
    still = settings.target_frame or level or scene.header.frame_id
    T_still_scene = lookup(still, scene.header.frame_id, scene.header.stamp)
    return np.linalg.inv(T_still_scene) @ lookup(still, header.frame_id, header.stamp)


def _depth_images(scene: Scene, settings: Settings, lookup: Lookup) -> list[dict[str, Any]]:
    """The images of a scene with their cameras; poses are in the frame of the scene's header."""
    images: list[dict[str, Any]] = []
    for depth, camera in ((scene.depth, scene.camera), *scene.others):
        image = {"depth": image_array(depth, DEPTH_ENCODINGS), "intrinsics": camera_matrix(camera)}
        images.append(image | {"T_cloud_camera": _pose_at(depth.header, scene, settings, lookup)})
    return images


def _from_frames(scene: Scene, settings: Settings, lookup: Lookup) -> dict[str, Any]:
    """Options derived from frames: the camera's position, and the up direction."""
    frame_id, stamp = scene.header.frame_id, scene.header.stamp
    asked: dict[str, Any] = {}
    if scene.cloud is not None:
        camera = settings.camera_frame or frame_id
        asked["viewpoint"] = lookup(frame_id, camera, stamp)[:3, 3].tolist()
    level = settings.gravity_frame or settings.target_frame
    if level not in ("", "none"):
        asked["up"] = lookup(frame_id, level, stamp)[:3, 2].tolist()
    return asked


def _points(scene: Scene, settings: Settings, lookup: Lookup) -> Any:
    """Points (N, 3) or (H, W, 3) of the scene's cloud or depth images, in the header's frame."""
    if scene.cloud is not None:
        return read_point_cloud2(scene.cloud).points
    images = _depth_images(scene, settings, lookup)
    views = [DepthView(to_intrinsics(one["intrinsics"]), one["T_cloud_camera"]) for one in images]
    return fuse_depth_images([one["depth"] for one in images], views).points
