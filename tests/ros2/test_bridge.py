"""The node's logic, with messages that went through CDR and a server behind the client."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cloud_files import point_cloud2
from tests.end_to_end import test_tracking

from edgegrasp_bridge import bridge
from edgegrasp_bridge.bridge import Inbox, Scene, Settings
from edgegrasp_camera import InvalidRequest
from edgegrasp_client import GraspClient, GraspTracker, InvalidRequestError, Robot
from edgegrasp_client.conversions import PANDA_LINK8, matrix_from_quaternion
from edgegrasp_client.options import DetectOptions
from edgegrasp_model.scene.cloud import pose_matrix
from edgegrasp_results import ArmPlan, ArmTrajectory
from edgegrasp_sim.poses import translation

from .conftest import Types

pytest.importorskip("rosbags", reason="the extra `ros2` is not installed")
sent = Types().sent  # a message of a type and fields, as it arrives

STAMP = {"sec": 12, "nanosec": 345}
HEADER = {"stamp": STAMP, "frame_id": "camera"}
MATRIX = [60.0, 0.0, 15.5, 0.0, 60.0, 11.5, 0.0, 0.0, 1.0]
DEPTH = np.random.default_rng(0).integers(500, 600, (24, 32)).astype(np.uint16)

T_base_camera = pose_matrix(Rotation.from_euler("x", 2.5).as_matrix(), (0.4, 0.0, 0.7))
FRAMES = {"camera": T_base_camera, "base": np.eye(4), "hand": np.eye(4), "link8": PANDA_LINK8}


def lookup(target: str, source: str, stamp: Any) -> np.ndarray:
    """tf2, of a robot that stands still."""
    assert stamp is None or (stamp.sec, stamp.nanosec) == (12, 345)
    return np.linalg.inv(FRAMES[target]) @ FRAMES[source]


def detect(client: Any, scene: Scene, settings=None, options=None, **more: Any) -> Any:
    return bridge.detect(client, scene, settings or Settings(), options or {}, lookup, **more)


@pytest.fixture(scope="module")
def client(dummy_server) -> Iterator[GraspClient]:
    with GraspClient(dummy_server.grpc_address) as client:
        yield client


def make_cloud(points: np.ndarray, frame_id: str = "camera", bigendian: bool = False) -> Any:
    """x, y, z and a colour in 20 bytes, rows padded by 4 more."""
    kind = np.dtype([*((name, "f4") for name in ("x", "y", "z", "rgb")), ("more", "u4")])
    rows = np.zeros(points.shape[:-1], kind)
    rows["x"], rows["y"], rows["z"] = np.moveaxis(points, -1, 0)
    layout = point_cloud2(np.atleast_2d(rows), padding=4, big=bigendian)
    layout["data"] = np.frombuffer(layout["data"], np.uint8)
    return sent("sensor_msgs/msg/PointCloud2", layout | {"header": HEADER | {"frame_id": frame_id}})


def make_image(pixels: np.ndarray, encoding: str = "16UC1", padding: int = 0) -> Any:
    flat = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(flat, ((0, 0), (0, padding)))
    size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": rows.shape[1]}
    fields = {"header": HEADER, "encoding": encoding, "data": rows.ravel()}
    return sent("sensor_msgs/msg/Image", size | fields)


PROJECTION = np.insert(np.reshape(MATRIX, (3, 3)), 3, 0.0, axis=1).ravel()
SIZE = {"header": HEADER, "height": 24, "width": 32}
CAMERA = sent("sensor_msgs/msg/CameraInfo", SIZE | {"k": [9.0] * 9, "p": PROJECTION})


def test_a_cloud_and_its_grasps_in_every_message(client, cloud) -> None:
    settings = Settings(target_frame="base", hand_frame="hand", parent_link="link8")
    found = detect(client, Scene(make_cloud(cloud)), settings, {"seed": 3, "top_k": 5})
    expected = client.detect(cloud, viewpoint=[0, 0, 0], seed=3, top_k=5).grasps
    hands = [T_base_camera @ grasp.T_cloud_hand for grasp in expected]
    assert len(hands) == 5

    poses = sent("geometry_msgs/msg/PoseArray", bridge.pose_array(found))
    assert (poses.header.frame_id, poses.header.stamp.sec) == ("base", 12)
    np.testing.assert_allclose([matrix(pose) for pose in poses.poses], hands, atol=1e-5)

    markers = sent("visualization_msgs/msg/MarkerArray", bridge.marker_array(found)).markers
    assert [marker.action for marker in markers] == [3, 0, 0, 0, 0, 0]
    fingers = np.array([[p.x, p.y, p.z] for p in markers[1].points])
    assert fingers.shape == (8, 3)
    in_hand = (fingers - hands[0][:3, 3]) @ hands[0][:3, :3]
    assert np.ptp(in_hand[:, 1]) == pytest.approx(expected[0].width, abs=1e-5)
    before = sent("geometry_msgs/msg/PoseArray", bridge.pose_array(found, 0.07)).poses[0]
    np.testing.assert_allclose(matrix(before), hands[0] @ translation(0, 0, -0.07), atol=1e-5)

    planned = bridge.moveit_grasps(found, settings, lookup)
    result = sent("grasping_msgs/msg/GraspPlanning_Result", planned)
    for grasp, hand, wanted in zip(result.grasps, hands, expected, strict=True):
        np.testing.assert_allclose(matrix(grasp.grasp_pose.pose), hand @ PANDA_LINK8, atol=1e-5)
        assert grasp.grasp_quality == pytest.approx(wanted.score)
        way = grasp.pre_grasp_approach.direction
        direction = [way.vector.x, way.vector.y, way.vector.z]
        np.testing.assert_allclose(direction, hand[:3, 2], atol=1e-5)
        for header in (way.header, grasp.grasp_pose.header):
            assert (header.frame_id, header.stamp.sec, header.stamp.nanosec) == ("base", 12, 345)
        assert grasp.pre_grasp_posture.points[0].positions.sum() == pytest.approx(wanted.width)

    fields = bridge.object_results(found, settings, "mug", most=2)
    (each,) = sent("edgegrasp_ros2/msg/GenerateGrasps_Result", fields).results
    assert (each.object_id, each.success, len(each.candidates)) == ("mug", True, 2)
    assert 0 <= each.candidates[1].confidence <= each.candidates[0].confidence <= 1
    np.testing.assert_allclose(matrix(each.candidates[0].pose.pose), hands[0], atol=1e-5)
    first = each.candidates[0]
    for pose, z in ((first.pregrasp, -0.05), (first.retreat, -0.1)):
        np.testing.assert_allclose(matrix(pose), hands[0] @ translation(0, 0, z), atol=1e-5)


def test_the_first_pose_follows_its_object_from_message_to_message(real_server):
    tracker, places = GraspTracker(max_object_size=0.3), []
    settings = Settings(camera_frame="camera")
    with GraspClient(real_server.grpc_address) as client:
        for number in range(3):
            scene = Scene(make_cloud(test_tracking.image(number)["cloud"], "base"))
            found = detect(client, scene, settings, tracker=tracker)
            poses = sent("geometry_msgs/msg/PoseArray", bridge.pose_array(found)).poses
            places.append(matrix(poses[0])[:3, 3])
    steps = np.diff(places, axis=0)
    np.testing.assert_allclose(steps, [(0, test_tracking.STEP, 0)] * 2, atol=0.003)


def matrix(pose: Any) -> np.ndarray:
    turn, place = pose.orientation, pose.position
    rotation = matrix_from_quaternion([turn.x, turn.y, turn.z, turn.w])
    return pose_matrix(rotation, (place.x, place.y, place.z))


@pytest.mark.parametrize(("kind", "encoding"), [(np.uint16, "16UC1"), (np.float32, "32FC1")])
def test_a_depth_image_with_its_camera(client, kind, encoding) -> None:
    depth = DEPTH if kind == np.uint16 else DEPTH.astype(kind) / 1000
    found = detect(client, Scene(depth=make_image(depth, encoding, padding=6), camera=CAMERA))
    expected = client.detect(depth_images=[{"depth": depth, "intrinsics": MATRIX}]).grasps
    assert found.header["frame_id"] == "camera"
    assert bridge.trajectories(found) == []
    both = ([grasp.T_cloud_hand for grasp in grasps] for grasps in (found.grasps, expected))
    np.testing.assert_allclose(*both, atol=1e-6)


@pytest.fixture
def asked(client, cloud) -> Mock:
    """In the place of a client: keeps what was asked, and answers always the same."""
    answer = replace(client.detect(cloud, top_k=1), grasps=[])
    return Mock(detect=Mock(return_value=answer))


def given(client: Mock) -> dict[str, Any]:
    """What it was last asked beside the cloud."""
    return client.detect.call_args.kwargs


def test_frames_say_where_the_camera_stands_and_what_is_up(asked, cloud) -> None:
    settings = Settings(camera_frame="camera", gravity_frame="base")
    detect(asked, Scene(make_cloud(cloud, "base")), settings)
    np.testing.assert_allclose(given(asked)["viewpoint"], [0.4, 0.0, 0.7])
    np.testing.assert_allclose(given(asked)["up"], [0, 0, 1], atol=1e-12)
    detect(asked, Scene(make_cloud(cloud)), settings, {"viewpoint": [1, 2, 3]})
    assert given(asked)["viewpoint"] == [1, 2, 3]
    np.testing.assert_allclose(given(asked)["up"], T_base_camera[2, :3], atol=1e-12)
    in_base = Settings(target_frame="base")
    detect(asked, Scene(make_cloud(cloud)), in_base)
    np.testing.assert_allclose(given(asked)["up"], T_base_camera[2, :3], atol=1e-12)
    detect(asked, Scene(make_cloud(cloud)), replace(in_base, gravity_frame="none"))
    assert "up" not in given(asked)


@pytest.mark.parametrize("encoding", ["mono8", "32SC1", "rgb8"])
def test_a_mask_says_where(asked, encoding) -> None:
    wanted = DEPTH > 550
    kinds = {"mono8": np.uint8, "32SC1": np.int32}
    pixels = wanted.astype(kinds.get(encoding, np.uint8)) * 7
    if encoding == "rgb8":
        pixels = np.stack([pixels * 0, pixels, pixels * 0], axis=-1)
    scene = Scene(None, make_image(DEPTH), CAMERA, make_image(pixels, encoding))
    detect(asked, scene)
    (inside,) = given(asked)["contact_region"]["include"]
    np.testing.assert_array_equal(inside["mask"], wanted)


@pytest.mark.parametrize("bigendian", [False, True])
def test_an_object_and_its_scene_come_apart(asked, bigendian):
    organised = np.full((4, 50, 3), np.nan, np.float32)
    organised[1:] = np.random.default_rng(0).uniform(0.3, 0.4, (3, 50, 3))
    wanted = organised[2, :20]
    in_base = wanted @ T_base_camera[:3, :3].T + T_base_camera[:3, 3]
    cluster = make_cloud(in_base, "base", bigendian)
    scene = Scene(make_cloud(organised, bigendian=bigendian))
    detect(asked, scene, object_cloud=cluster)
    (both,) = asked.detect.call_args.args
    np.testing.assert_allclose(both[given(asked)["segment_ids"] == 1], wanted, atol=1e-5)
    assert len(wanted) + 100 < len(both) <= 150

    detect(asked, Scene(depth=make_image(DEPTH), camera=CAMERA), object_cloud=cluster)
    (both,) = asked.detect.call_args.args
    around = both[given(asked)["segment_ids"] == 0]
    assert len(around) == DEPTH.size
    column = 60.0 * around[:, 0] / around[:, 2] + 15.5
    np.testing.assert_allclose(column.reshape(24, 32)[0], np.arange(32), atol=1e-3)

    detect(asked, Scene(), object_cloud=cluster)
    assert asked.detect.call_args.args[0] is cluster


def test_no_grasp_and_an_aborted_goal_say_why(asked, cloud) -> None:
    found = detect(asked, Scene(make_cloud(cloud)))
    for fields, message in (
        (bridge.object_results(found, Settings(), "mug"), "No grasp: 500 points"),
        (bridge.failed_result("mug", LookupError("no frame")), "LookupError: no frame"),
    ):
        (each,) = sent("edgegrasp_ros2/msg/GenerateGrasps_Result", fields).results
        assert (each.object_id, each.success) == ("mug", False)
        assert message in each.message


def test_a_mask_is_of_the_image_it_was_made_of_and_grows_old() -> None:
    def at(second: int, pixels: np.ndarray, encoding: str) -> Any:
        image = make_image(pixels, encoding)
        image.header.stamp.sec = second
        return image

    inbox, mask = Inbox(), np.ones((24, 32), np.uint8)
    assert inbox.scene(1.5) == Scene()
    assert not inbox.take("camera", CAMERA, 1.5)
    first, second, third = (at(sec, DEPTH, "16UC1") for sec in (1, 2, 9))
    assert inbox.take("depth", first, 1.5)
    assert inbox.take("depth", second, 1.5)
    assert inbox.scene(1.5) == Scene(depth=second, camera=CAMERA)
    of_first = at(1, mask, "mono8")
    assert inbox.take("mask", of_first, 1.5)
    assert inbox.scene(1.5) == Scene(depth=first, camera=CAMERA, mask=of_first)
    late = sent("sensor_msgs/msg/CameraInfo", SIZE | {"header": HEADER | {"frame_id": "late"}})
    assert inbox.take("camera", late, 1.5)  # the first of its camera
    assert not inbox.take("depth", second, 1.5)  # its mask is still to come
    assert inbox.take("depth", first, 1.5)  # that of the mask, which came before it
    assert inbox.take("depth", third, 1.5)  # the masks have stopped: an error
    with pytest.raises(ValueError, match="mask is 8 s older than the newest image"):
        inbox.scene(2.0)
    assert inbox.scene(0.0) == Scene(depth=third, camera=CAMERA)
    inbox.take("mask", at(8, mask, "mono8"), 1.5)
    with pytest.raises(ValueError, match="No image has the stamp of the mask"):
        inbox.scene(1.5)


def test_a_slow_camera_stays_in_the_scene_and_the_first_image_waits_for_its_camera() -> None:
    inbox, slow = Inbox(), make_image(DEPTH)
    slow.header.frame_id = "a"
    inbox.take("depth", slow, 1.0)
    assert inbox.take("camera", CAMERA, 1.0)
    for second in range(40):
        fast = make_image(DEPTH)
        fast.header.stamp.sec += second // 10
        inbox.take("depth", fast, 1.0)
    assert inbox.scene(1.0).depth is slow
    fast.header.stamp.sec += 9  # the slow one has stopped
    assert inbox.scene(1.0).depth is fast
    inbox.take("depth", slow, 1.0)  # it is late
    assert inbox.scene(1.0).others == ()


def test_images_of_several_cameras_are_one_cloud(asked) -> None:
    aside, other = make_image(DEPTH), SIZE | {"header": HEADER | {"frame_id": "link8"}}
    aside.header.frame_id = "link8"
    aside.header.stamp.sec = 11
    images, inbox = [aside, make_image(DEPTH)], Inbox()
    tf2 = Mock(side_effect=lambda target, source, _: np.linalg.inv(FRAMES[target]) @ FRAMES[source])
    for camera in (CAMERA, sent("sensor_msgs/msg/CameraInfo", other | {"p": PROJECTION})):
        inbox.take("camera", camera, 0.0)
    for last in (aside, images[1]):  # the cloud's frame is the same
        for image in (*images, last):
            inbox.take("depth", image, 0.0)
        bridge.detect(asked, inbox.scene(0.0), Settings(gravity_frame="base"), {}, tf2)
        asked_for = {(*each.args[:2], each.args[2].sec) for each in tf2.call_args_list}
        assert {("base", "camera", 12), ("base", "link8", 11)} < asked_for
        poses = [image["T_cloud_camera"] for image in given(asked)["depth_images"]]
        expected = [np.eye(4), np.linalg.inv(T_base_camera) @ PANDA_LINK8]
        np.testing.assert_allclose(poses, expected, atol=1e-12)


def test_an_image_may_be_a_part_of_the_sensor_s_binned() -> None:
    part = {"binning_x": 2, "binning_y": 2, "roi": {"x_offset": 4, "y_offset": 2}}
    info = sent("sensor_msgs/msg/CameraInfo", SIZE | part | {"p": PROJECTION})
    expected = [[30, 0, 5.75], [0, 30, 4.75], [0, 0, 1]]
    np.testing.assert_allclose(bridge.camera_matrix(info), expected)


def test_every_option_is_a_parameter(client, cloud) -> None:
    parameters = bridge.parameters()
    assert {f"options.{name}" for name in DetectOptions.__annotations__} < set(parameters)
    given = parameters | {
        "options.top_k": 2,
        "options.objects": False,  # off, as YAML reads it
        "options.up": [0.0, 0.0, 1.0],
        "options.support": "none",
        "options.workspace": '{"min": [-1, -1, -1], "max": [1, 1, 1]}',
        "target_frame": "base",
        "joint_names": ["finger"],
    }
    settings, options = bridge.read_parameters(given)
    assert settings.joints.at(0.08) == {"finger": 0.04}
    assert options["workspace"]["max"] == [1, 1, 1]
    assert options["objects"] == "off"
    assert len(detect(client, Scene(make_cloud(cloud)), settings, options).grasps) == 2
    with pytest.raises(InvalidRequestError, match="top_k"):
        detect(client, Scene(make_cloud(cloud)), settings, options | {"top_k": "many"})


def test_messages_that_cannot_be_used(client, cloud) -> None:
    image = make_image(DEPTH)
    empty = sent("sensor_msgs/msg/CameraInfo", {"header": HEADER})
    flat = make_cloud(cloud)
    flat.fields[0].name = "intensity"
    for scene, cluster, message in (
        (Scene(), None, "No cloud and no depth image has arrived yet"),
        (Scene(depth=image), None, "no CameraInfo yet"),
        (Scene(depth=image, camera=empty), None, "p and k are 0"),
        (Scene(depth=make_image(DEPTH, "bayer"), camera=CAMERA), None, "encoding: got 'bayer'"),
        (Scene(depth=make_image(DEPTH.astype("i4"), "32SC1"), camera=CAMERA), None, "'32SC1' for"),
        (Scene(make_cloud(cloud)), flat, "Send x too, as 7"),
    ):
        with pytest.raises((ValueError, InvalidRequest), match=message):
            detect(client, scene, object_cloud=cluster)


ARM = Robot(
    "arm", "panda", "base", ["a", "b"], *(np.zeros(2),) * 5,
    frames=np.zeros((3, 4, 4)), axes=np.zeros((2, 3)), sliding=[False, False],
)  # fmt: skip


@pytest.fixture
def planning(client, cloud) -> Mock:
    """A client of a server with an arm, which plans a motion to the first grasp."""
    found = client.detect(cloud, top_k=1)
    rows = np.arange(14.0).reshape(7, 2)
    motion = ArmTrajectory(["a", "b"], 0.75 * np.arange(7), rows, -rows, 1, 3, 5)
    arm = ArmPlan(True, rows[1], rows[3], motion)
    answer = replace(found, grasps=[replace(found.grasps[0], arm=arm)])
    return Mock(detect=Mock(return_value=answer), robots=Mock(return_value=[ARM]))


def test_the_best_pick_is_a_trajectory_of_the_arm(planning, cloud) -> None:
    inbox = Inbox()
    inbox.take("cloud", make_cloud(cloud), 1.0)
    for names, positions in ((["b", "finger"], [0.2, 0.04]), (["a"], [0.1])):
        state = {"name": names, "position": positions}
        assert not inbox.take("joints", sent("sensor_msgs/msg/JointState", state), 1.0)
    _, options = bridge.read_parameters(bridge.parameters() | {"options.robot": "arm"})
    found = detect(planning, inbox.scene(1.0), options=options)
    robot, first = given(planning)["robot"], 0
    assert robot["joints"] == [0.1, 0.2]
    np.testing.assert_allclose(np.reshape(robot["T_base_cloud"], (4, 4)), T_base_camera)
    for fields, last in zip(bridge.trajectories(found), (3, 5, 6), strict=True):
        motion = sent("trajectory_msgs/msg/JointTrajectory", fields)
        assert list(motion.joint_names) == ["a", "b"]
        times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in motion.points]
        np.testing.assert_allclose(times, 0.75 * np.arange(last - first + 1))
        assert list(motion.points[0].positions) == [2 * first, 2 * first + 1]
        assert list(motion.points[-1].velocities) == [-2 * last, -2 * last - 1]
        first = last


def test_a_known_arm_is_where_it_is_before_a_scene(planning, cloud) -> None:
    """The cloud of an action's object may be the only one."""
    scene, options = Scene(joints={"a": 0.1, "b": 0.2}), {"robot": "arm"}
    detect(planning, scene, options=options, object_cloud=make_cloud(cloud))
    assert given(planning)["robot"]["joints"] == [0.1, 0.2]
    planning.robots.reset_mock()  # they are known until there is an error
    detect(planning, scene, options=options, object_cloud=make_cloud(cloud))
    planning.robots.assert_not_called()
    unknown, lacking = ("other", {}), ("arm", {"a": 0.1})
    for (name, joints), said in ((unknown, "robots are arm"), (lacking, "no position of 'b'")):
        scene = Scene(make_cloud(cloud), joints=joints)
        with pytest.raises(ValueError, match=said):
            detect(planning, scene, options={"robot": {"name": name}})
