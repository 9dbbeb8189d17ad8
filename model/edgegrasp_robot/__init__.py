"""From grasps to joint positions and motions of an arm; needs the extra `robot`."""

try:
    from edgegrasp_robot.picks import options_for_robot, plan_picks
    from edgegrasp_robot.robot import Robot, load_robot, load_robots, robot_names
except ModuleNotFoundError as error:
    message = f"{error.name} is not installed, and arms need it: pip install 'edgegrasp[robot]'"
    raise ModuleNotFoundError(message, name=error.name) from None

__all__ = ["Robot", "load_robot", "load_robots", "options_for_robot", "plan_picks", "robot_names"]
