"""Pick and place with a Panda arm in simulation: from the camera's image to things in a tray.

usage: python examples/06_pick_and_place.py [--server ADDRESS] [--picks 3]

The grasps of an image are tried best first, until one is found whose hand poses the arm reaches
(inverse kinematics within its joint limits) on a way on which it touches nothing. Needs the extra
`sim`.
"""

import argparse
from collections.abc import Iterator, Sequence

import numpy as np
import pybullet as p
import pybullet_data
from numpy.typing import NDArray

from edgegrasp_client import GraspClient, Workspace
from edgegrasp_client.conversions import quaternion_from_matrix
from edgegrasp_sim.camera import look_at

Array = NDArray[np.float64]

THINGS = ("duck_vhacd.urdf", "lego/lego.urdf", "jenga/jenga.urdf", "objects/mug.urdf")
WORKSPACE: Workspace = {
    "min": (0.3, -0.25, -0.05),
    "max": (0.75, 0.25, 0.4),
}  # metres, the arm's base frame
TRAY = np.array([0.15, -0.5, 0.0])  # metres
EYE, MIDDLE = np.array([1.0, 0.1, 0.65]), np.array([0.5, 0.0, 0.02])
FOCAL, ROWS, COLUMNS, NEAR, FAR = 540.0, 480, 640, 0.1, 2.0
HAND, FINGERS = 8, (9, 10)  # links of the arm
HOME = (0.0, -0.6, 0.0, -2.3, 0.0, 1.7, 0.785)  # radians
AHEAD = 0.06  # metres before the grasp, where the straight way in begins
MEETS = -0.001  # metres; things that lie deeper than this in each other touch


class Cell:
    """An arm, a table with things on it, a tray and a camera."""

    def __init__(self, seed: int) -> None:
        p.connect(p.DIRECT)
        p.setAdditionalSearchPath(pybullet_data.getDataPath())
        p.setGravity(0.0, 0.0, -9.81)
        self.table = p.loadURDF("plane.urdf")
        self.arm = p.loadURDF("franka_panda/panda.urdf", useFixedBase=True)
        self.tray = p.loadURDF("tray/traybox.urdf", TRAY.tolist(), globalScaling=0.6)
        rng = np.random.default_rng(seed)
        self.things: list[int] = []
        for row, name in enumerate(THINGS):
            place = (0.45 + 0.15 * (row % 2), -0.1 + 0.2 * (row // 2), 0.08)
            turn = p.getQuaternionFromEuler([0.0, 0.0, float(rng.uniform(0.0, 2 * np.pi))])
            self.things.append(p.loadURDF(name, place, turn))
        self.put(HOME)
        self.move(HOME, opening=0.08)
        for _ in range(480):
            p.stepSimulation()

    def depth_image(self) -> tuple[Array, Array]:
        """What the camera sees, (H, W) metres, and T_base_camera (4, 4)."""
        T_base_camera = look_at(EYE, MIDDLE)
        view = np.linalg.inv(T_base_camera)
        view[1:3] *= -1.0  # OpenGL's camera looks along -z with y up
        half = NEAR / FOCAL * np.array([COLUMNS, ROWS]) / 2
        lens = p.computeProjectionMatrix(-half[0], half[0], -half[1], half[1], NEAR, FAR)
        image = p.getCameraImage(COLUMNS, ROWS, view.flatten(order="F").tolist(), lens)
        buffer = np.asarray(image[3], dtype=np.float64).reshape(ROWS, COLUMNS)
        depth = FAR * NEAR / (FAR - (FAR - NEAR) * buffer)
        depth[depth > 0.99 * FAR] = np.nan
        return depth, T_base_camera

    def joints(self) -> Array:
        """The arm's angles now, (7,) radians."""
        return np.array([p.getJointState(self.arm, joint)[0] for joint in range(7)])

    def put(self, angles: Sequence[float] | Array) -> None:
        """Set the angles at once."""
        for joint, angle in enumerate(angles):
            p.resetJointState(self.arm, joint, float(angle))

    def reach(self, T_base_hand: Array, start: Sequence[float] | Array) -> Array | None:
        """Angles (7,) that bring the hand there, near to `start`; None: the arm cannot."""
        limits = np.array(
            [p.getJointInfo(self.arm, joint)[8:10] for joint in (*range(7), *FINGERS)]
        )
        now, quaternion = self.joints(), quaternion_from_matrix(T_base_hand[:3, :3]).tolist()
        self.put(start)
        for _ in range(4):
            found = p.calculateInverseKinematics(
                self.arm, HAND, T_base_hand[:3, 3].tolist(), quaternion,
                lowerLimits=limits[:, 0].tolist(), upperLimits=limits[:, 1].tolist(),
                jointRanges=np.ptp(limits, axis=1).tolist(), restPoses=[*start, 0.04, 0.04],
                maxNumIterations=200, residualThreshold=1e-6,
            )  # fmt: skip
            self.put(found[:7])
        state = p.getLinkState(self.arm, HAND, computeForwardKinematics=True)
        self.put(now)
        reached = np.array(p.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        angles = np.array(found[:7])
        off = np.linalg.norm(np.array(state[4]) - T_base_hand[:3, 3])
        turned = np.abs(reached - T_base_hand[:3, :3]).max()
        inside = (angles >= limits[:7, 0]) & (angles <= limits[:7, 1])
        return angles if off < 0.003 and turned < 0.02 and inside.all() else None

    def free(self, start: Sequence[float] | Array, end: Sequence[float] | Array) -> bool:
        """Whether the arm touches nothing on the way between two sets of angles."""
        now = self.joints()
        touched = False
        for angles in np.linspace(start, end, 25):
            self.put(angles)
            for body in (*self.things, self.tray, self.table):
                near = p.getClosestPoints(self.arm, body, 0.0)
                # Its foot stands on the table.
                touched |= any(point[8] < MEETS and point[3] > 0 for point in near)
        self.put(now)
        return not touched

    def move(self, angles: Sequence[float] | Array, opening: float, seconds: float = 1.0) -> None:
        """Drive the arm there along a straight line of angles, the fingers to an opening."""
        steps = int(240 * seconds)
        for target in np.linspace(self.joints(), angles, steps):
            p.setJointMotorControlArray(
                self.arm, range(7), p.POSITION_CONTROL, target.tolist(), forces=[240.0] * 7
            )
            for finger in FINGERS:
                p.setJointMotorControl2(
                    self.arm, finger, p.POSITION_CONTROL, opening / 2, force=30.0, maxVelocity=0.1
                )
            p.stepSimulation()

    def in_tray(self) -> int:
        """How many things lie over the tray."""
        places = np.array([p.getBasePositionAndOrientation(thing)[0] for thing in self.things])
        return int((np.abs(places[:, :2] - TRAY[:2]) < 0.2).all(axis=1).sum())


def plans(cell: Cell, grasps: Sequence[Array]) -> Iterator[tuple[Array, Array, Array]]:
    """Angles before a grasp, at it and over it, for each that the arm reaches touching nothing."""
    for T_base_hand in grasps:
        before, over = T_base_hand.copy(), T_base_hand.copy()
        before[:3, 3] -= AHEAD * T_base_hand[:3, 2]
        over[2, 3] += 0.2
        first = cell.reach(before, HOME)
        at = None if first is None else cell.reach(T_base_hand, first)
        last = None if at is None else cell.reach(over, at)
        if first is None or at is None or last is None:
            continue
        if cell.free(HOME, first) and cell.free(first, at):
            yield first, at, last


def pick_and_place(cell: Cell, client: GraspClient) -> bool:
    """Look, choose a grasp, and bring what it holds to the tray; False: none is within reach."""
    depth, T_base_camera = cell.depth_image()
    intrinsics = (FOCAL, FOCAL, COLUMNS / 2, ROWS / 2 - 1)
    found = client.detect(
        depth_images=[{"depth": depth, "intrinsics": intrinsics, "T_cloud_camera": T_base_camera}],
        up=(0.0, 0.0, 1.0),
        workspace=WORKSPACE,
        collision={"approach_length": AHEAD},
        top_k=100,
    )
    poses = [grasp.T_cloud_hand.astype(np.float64) for grasp in found.grasps]
    plan = next(plans(cell, poses), None)
    print(f"{len(poses)} grasps; {'none' if plan is None else 'one'} within the arm's reach")
    if plan is None:
        return False
    before, at, over = plan
    cell.move(before, 0.08)
    cell.move(at, 0.08)
    cell.move(at, 0.0)
    cell.move(over, 0.0)
    cell.move(HOME, 0.0)
    down = np.eye(4)
    down[:3, :3] = np.diag([1.0, -1.0, -1.0])
    down[:3, 3] = TRAY + np.array([0.0, 0.0, 0.35])
    drop = cell.reach(down, (-1.2, *HOME[1:]))
    assert drop is not None
    cell.move(drop, 0.0)
    cell.move(drop, 0.08, 0.5)
    cell.move(HOME, 0.08)
    return True


def main(address: str, picks: int, seed: int) -> None:
    """Pick things, one image each."""
    cell = Cell(seed)
    with GraspClient(address) as client:
        for _ in range(picks):
            if not pick_and_place(cell, client):
                break
            print(f"{cell.in_tray()} of {len(THINGS)} things in the tray")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--server", default="127.0.0.1:50051", metavar="ADDRESS")
    parser.add_argument("--picks", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    main(given.server, given.picks, given.seed)
