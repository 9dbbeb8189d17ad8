"""The node in a real ROS 2, where there is one: a cloud in, poses and markers out."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

for name in ("rclpy", "rosidl_runtime_py", "tf2_ros", "visualization_msgs"):
    pytest.importorskip(name, reason="there is no ROS 2 here")

NODE = Path(__file__).parents[2] / "clients" / "ros2" / "edgegrasp_bridge" / "node.py"


def test_a_cloud_in_poses_and_markers_out(dummy_server, cloud: np.ndarray) -> None:
    import rclpy
    from geometry_msgs.msg import PoseArray
    from sensor_msgs.msg import PointCloud2, PointField
    from visualization_msgs.msg import MarkerArray

    set_here = {"server": dummy_server.grpc_address, "on_message": True, "options.top_k": 3}
    words = [word for name, value in set_here.items() for word in ("-p", f"{name}:={value}")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(NODE.parents[1]), *sys.path])}
    command = [sys.executable, "-P", str(NODE), "--ros-args", *words]
    process = subprocess.Popen(command, env=environment)
    rclpy.init()
    try:
        node = rclpy.create_node("test")
        got: dict[str, Any] = {}
        node.create_subscription(PoseArray, "grasps", lambda m: got.update(poses=m), 1)
        node.create_subscription(MarkerArray, "grasp_markers", lambda m: got.update(markers=m), 1)
        publisher = node.create_publisher(PointCloud2, "points", 1)
        fields = [
            PointField(name=n, offset=4 * i, datatype=7, count=1) for i, n in enumerate("xyz")
        ]
        message = PointCloud2(height=1, width=len(cloud), fields=fields, point_step=12)
        message.row_step, message.data = 12 * len(cloud), cloud.tobytes()
        message.header.frame_id = "camera"
        while len(got) < 2 and process.poll() is None:
            publisher.publish(message)
            rclpy.spin_once(node, timeout_sec=0.2)
            time.sleep(0.1)
        assert got["poses"].header.frame_id == "camera"
        assert len(got["poses"].poses) == 3
        assert len(got["markers"].markers) == 4
    finally:
        process.terminate()
        process.wait(timeout=20)
        rclpy.shutdown()
