#!/usr/bin/env python3
"""The node: only the parts that need rclpy; `bridge` has all other logic."""

import importlib
from contextlib import closing, suppress
from functools import partial
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.action import ActionServer
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from rosidl_runtime_py.set_message import set_message_fields
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2
from tf2_ros import Buffer, TransformListener
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from edgegrasp_bridge import bridge
from edgegrasp_client import GraspClient, GraspTracker

INPUTS = {  # topics: kinds of message, and fields of bridge.Scene
    "points": (PointCloud2, "cloud"),
    "depth": (Image, "depth"),
    "camera_info": (CameraInfo, "camera"),
    "mask": (Image, "mask"),
    "joint_states": (JointState, "joints"),
}
MOTIONS = ("trajectory_to_grasp", "trajectory_with_object", "trajectory_after_place")


class EdgeGraspNode(Node):
    """Subscribes to clouds or depth images, answers two actions, and publishes grasps."""

    def __init__(self) -> None:
        super().__init__("edgegrasp")
        for name, default in bridge.parameters().items():
            self.declare_parameter(name, default, ParameterDescriptor(dynamic_typing=True))
        settings, _ = self._read()
        self.client = GraspClient(settings.server, timeout=settings.timeout)
        self._inbox = bridge.Inbox()
        self._followed: Any = None  # the tracker's options and frame
        self._tracker = GraspTracker()
        self._buffer = Buffer()
        self._listener = TransformListener(self._buffer, self)
        self._poses = self.create_publisher(PoseArray, "grasps", 1)
        self._before = self.create_publisher(PoseArray, "pregrasps", 1)
        self._markers = self.create_publisher(MarkerArray, "grasp_markers", 1)
        inputs, actions = MutuallyExclusiveCallbackGroup(), ReentrantCallbackGroup()
        # In its own callback group, so that inputs do not queue up while a detection runs.
        self._news = self.create_guard_condition(
            self._detect_newest, MutuallyExclusiveCallbackGroup()
        )
        self._motions = [self.create_publisher(JointTrajectory, name, 1) for name in MOTIONS]
        for topic, (kind, field) in INPUTS.items():
            take = partial(self._take, field)
            self.create_subscription(
                kind, topic, take, qos_profile_sensor_data, callback_group=inputs
            )
        for package, name, answer, failed in (
            ("grasping_msgs", "GraspPlanning", self._plan, None),
            ("edgegrasp_ros2", "GenerateGrasps", self._generate, bridge.failed_result),
        ):
            try:
                kind = getattr(importlib.import_module(f"{package}.action"), name)
            except ModuleNotFoundError:
                self.get_logger().warning(f"{package} is not installed: no action {name}")
                continue
            topic = "plan_grasps" if name == "GraspPlanning" else "generate_grasps"
            execute = partial(self._execute, kind, answer, failed)
            ActionServer(self, kind, topic, execute, callback_group=actions)

    def _read(self) -> Any:
        names = list(bridge.parameters())
        values = [parameter.value for parameter in self.get_parameters(names)]
        return bridge.read_parameters(dict(zip(names, values, strict=True)))

    def _take(self, field: str, message: Any) -> None:
        new = self._inbox.take(field, message, self.get_parameter("mask_age").value)
        if new and self.get_parameter("on_message").value:
            self._news.trigger()

    def _detect_newest(self) -> None:
        try:
            self._detect(follow=self.get_parameter("follow").value)
        except Exception as error:  # including tf2's: the node continues with the next message
            self.get_logger().warning(f"{type(error).__name__}: {error}")

    def _detect(self, object_cloud: Any = None, follow: bool = False) -> Any:
        settings, options = self._read()
        object_cloud = object_cloud if object_cloud and object_cloud.data else None
        scene = self._inbox.scene(0.0 if object_cloud is not None else settings.mask_age)
        asked = options, scene.header and scene.header.frame_id
        if follow and asked != self._followed:
            self._followed, self._tracker = asked, GraspTracker(**options)
        tracker = self._tracker if follow else None
        found = bridge.detect(
            self.client, scene, settings, options, self._lookup, object_cloud, tracker
        )
        for warning in found.warnings:
            self.get_logger().warning(warning)
        if settings.follow and not follow:  # an action's answer does not replace the followed grasp
            return found, settings
        motions = zip(self._motions, bridge.trajectories(found), strict=False)
        for publisher, message, fields in (
            (self._poses, PoseArray(), bridge.pose_array(found)),
            (self._before, PoseArray(), bridge.pose_array(found, settings.approach_distance)),
            (self._markers, MarkerArray(), bridge.marker_array(found)),
            *((publisher, JointTrajectory(), fields) for publisher, fields in motions),
        ):
            set_message_fields(message, fields)
            publisher.publish(message)
        return found, settings

    def _execute(self, kind: Any, answer: Any, failed: Any, goal: Any) -> Any:
        result = kind.Result()
        try:
            set_message_fields(result, answer(goal.request))
            goal.succeed()
        except Exception as error:  # including tf2's: report the failed goal, and continue
            self.get_logger().error(f"{type(error).__name__}: {error}")
            if failed is not None:
                set_message_fields(result, failed(goal.request.object_id, error))
            goal.abort()
        return result

    def _plan(self, goal: Any) -> bridge.Message:
        found, settings = self._detect(goal.object.point_cluster)
        return bridge.moveit_grasps(found, settings, self._lookup)

    def _generate(self, goal: Any) -> bridge.Message:
        found, settings = self._detect(goal.object_cloud)
        return bridge.object_results(found, settings, goal.object_id, goal.max_candidates)

    def _lookup(self, target: str, source: str, stamp: Any) -> bridge.Float64:
        if target == source:
            return np.eye(4)
        when = Time() if stamp is None else Time.from_msg(stamp)
        found = self._buffer.lookup_transform(target, source, when, Duration(seconds=1.0))
        return bridge.matrix_from_transform(found.transform)


def main() -> None:
    """Run the node."""
    rclpy.init()
    executor = MultiThreadedExecutor()
    executor.add_node(node := EdgeGraspNode())
    with suppress(KeyboardInterrupt, ExternalShutdownException), closing(node.client):
        executor.spin()


if __name__ == "__main__":
    main()
