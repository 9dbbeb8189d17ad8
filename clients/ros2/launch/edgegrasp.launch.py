"""The node with its topics: `ros2 launch edgegrasp_ros2 edgegrasp.launch.py depth:=/my/depth`."""

from pathlib import Path

from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

PARAMETERS = Path(__file__).with_name("edgegrasp.yaml")
TOPICS = ("points", "depth", "camera_info", "mask", "joint_states")


def generate_launch_description() -> LaunchDescription:
    """Arguments: the topics, a file with the node's parameters, and the server's address.

    A given address overrides the address in the file.
    """
    defaults = {name: name for name in TOPICS} | {"server": "", "parameters": str(PARAMETERS)}
    arguments = [DeclareLaunchArgument(name, default_value=one) for name, one in defaults.items()]
    return LaunchDescription([*arguments, OpaqueFunction(function=_node)])


def _node(context: LaunchContext) -> list[Node]:
    server = LaunchConfiguration("server").perform(context)
    node = Node(
        package="edgegrasp_ros2",
        executable="edgegrasp_node",
        name="edgegrasp",
        output="screen",
        parameters=[LaunchConfiguration("parameters"), *([{"server": server}] if server else [])],
        remappings=[(name, LaunchConfiguration(name)) for name in TOPICS],
    )
    return [node]
