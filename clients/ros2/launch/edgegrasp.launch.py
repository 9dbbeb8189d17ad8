"""The node with its topics: `ros2 launch edgegrasp_ros2 edgegrasp.launch.py depth:=/my/depth`."""

from pathlib import Path

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

PARAMETERS = Path(__file__).with_name("edgegrasp.yaml")
TOPICS = ("points", "depth", "camera_info", "mask", "joint_states")


def generate_launch_description() -> LaunchDescription:
    """Arguments: the topics, and a file with the node's parameters."""
    arguments = [DeclareLaunchArgument(name, default_value=name) for name in TOPICS]
    arguments.append(DeclareLaunchArgument("parameters", default_value=str(PARAMETERS)))
    node = Node(
        package="edgegrasp_ros2",
        executable="edgegrasp_node",
        name="edgegrasp",
        output="screen",
        parameters=[LaunchConfiguration("parameters")],
        remappings=[(name, LaunchConfiguration(name)) for name in TOPICS],
    )
    return LaunchDescription([*arguments, node])
