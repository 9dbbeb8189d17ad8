"""Clutter removal in simulation: make a scene, observe it, grasp in it."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edgegrasp_camera.arrays import Float64
from edgegrasp_camera.picture import shaded
from edgegrasp_results import ArmTrajectory
from edgegrasp_sim import hand
from edgegrasp_sim.camera import CAMERA, FAR_SHARE, Observation, TableView, crop, unproject_to_world
from edgegrasp_sim.engine import ArmModel, Vector, make_world
from edgegrasp_sim.engine.urdf import least_width
from edgegrasp_sim.fixed_parts import OPEN_TABLE, TABLE_HEIGHT, FixedParts
from edgegrasp_sim.hand import MIN_OPENING, ArmDriver, GraspResult, HandDriver, run_grasp
from edgegrasp_sim.objects import ObjectModel, ObjectSet, SceneKind
from edgegrasp_sim.poses import require_pose
from edgegrasp_sim.scene import SCALES, SCENE_MAKERS, Layout, SceneObject, load_object, settle
from edgegrasp_sim.sensor import DepthNoise, DepthSensor

NOISE_STD = 0.001  # metres
WOOD = np.array([168.0, 140.0, 110.0])  # colour of the fixed parts
# Colours of objects, RGB; none is yellow, the colour of good grasps.
PAINTS = np.reshape([*bytes.fromhex("E6483C 3484D2 EE8032 3EB074 F5F0E2 9660B4 344256")], (-1, 3))
_ALOFT = np.array([[0.0, 0.0, 0.015], [0.0, 0.0, 0.0]])  # metres; extends the box below the table
_AROUND = np.array([[-0.06], [0.06]])  # metres; wrong depths move points this far out
_EVERYWHERE = np.array([[-np.inf], [np.inf]])
_CROP_MARGIN = 0.01  # metres; noise cannot move points farther out back in


@dataclass(frozen=True, slots=True)
class ObjectPlacement:
    """The pose of an object."""

    urdf: Path  # its description
    scale: float  # factor on the description's size
    position: tuple[float, float, float]  # centre of mass, world frame, metres
    quaternion_xyzw: tuple[float, float, float, float]  # orientation in the world


class ClutterSimulation(AbstractContextManager["ClutterSimulation"]):
    """Objects, a camera and a hand; equal calls after equal seeds give equal results."""

    def __init__(
        self,
        objects: ObjectSet | None = None,  # for scenes; None: each kind's built-in objects
        *,
        engine: str | None = None,
        gripper: Mapping[str, Any] | None = None,
        arm: ArmModel | None = None,
        min_opening: float = MIN_OPENING,  # metres; a hand that is open by less holds nothing
    ) -> None:
        self.gripper, self.arm, self.min_opening = gripper, arm, min_opening
        self.hand = hand.panda() if gripper is None else hand.hand_model(gripper)
        self.object_set, self.fixed_parts = objects, OPEN_TABLE
        self.world = make_world(engine)
        self._objects: list[SceneObject] = []
        self._obstacles: frozenset[int] = frozenset()
        self._gripper: HandDriver | None = None
        self._rest_state: Any = None

    def __exit__(self, *_: object) -> None:
        self.world.close()

    @property
    def num_objects(self) -> int:
        """Number of objects left."""
        return len(self._objects)

    @property
    def object_models(self) -> list[ObjectModel]:
        """Models of the objects that are left."""
        return [item.model for item in self._objects]

    @property
    def too_wide(self) -> list[ObjectModel]:
        """Models of the objects whose least width exceeds the hand's opening."""
        opening, there = self.hand.max_opening, self._objects
        return [one.model for one in there if least_width(one.model.urdf) * one.scale > opening]

    @property
    def object_bounds(self) -> Float64:
        """The bounding box of each object that is left: (K, 2, 3) metres, world frame."""
        return np.array([item.body.bounds for item in self._objects]).reshape(-1, 2, 3)

    @property
    def placements(self) -> list[ObjectPlacement]:
        """The poses of the objects, for `reset_from_poses`."""
        return [
            ObjectPlacement(item.model.urdf, item.scale, (x, y, z), turn)
            for item in self._objects
            for (x, y, z), turn in [(item.body.position.tolist(), item.body.quaternion_xyzw)]
        ]

    def reset(
        self,
        scene: SceneKind | str,  # a kind or its name
        rng: np.random.Generator,  # the scene's own stream
        num_objects: int = 5,  # how many to try to place
        scales: tuple[float, float] | None = None,  # range of the objects' scale; None: default
        table: FixedParts = OPEN_TABLE,  # of packed and pile scenes
    ) -> int:
        """Make a new scene at rest; returns its number of objects."""
        kind = SceneKind(scene)
        objects = self.object_set or ObjectSet.builtin(kind)
        surround, make = SCENE_MAKERS[kind]
        around = self._clear(table if surround is None else surround(rng))
        scales = scales or SCALES[kind.objects]
        self._objects = make(Layout(self.world, around, objects, rng, num_objects, scales))
        self._gripper = self._add_gripper()
        return self.num_objects

    def reset_from_poses(
        self, placements: Sequence[ObjectPlacement], fixed_parts: FixedParts = OPEN_TABLE
    ) -> None:
        """Place objects exactly at the given poses, at rest, without simulating."""
        self._clear(fixed_parts)
        for placement in placements:
            model = ObjectModel(placement.urdf.stem, placement.urdf)
            item = load_object(
                self.world, model, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), placement.scale
            )
            item.body.set_pose(placement.position, placement.quaternion_xyzw)
            self._objects.append(item)
        self._gripper = self._add_gripper()

    def move(self, number: int, position: Vector, quaternion_xyzw: Vector) -> None:
        """Move one of the `placements`, by its index, without simulating."""
        self._rest_state = None
        self._objects[number].body.set_pose(position, quaternion_xyzw)

    def observe_from(
        self,
        T_world_cameras: Sequence[Float64],  # one for each image
        rng_noise: np.random.Generator,  # stream of the noise
        *,
        noise_std: float = NOISE_STD,  # of each coordinate of each point, metres
        faults: Sequence[DepthNoise | DepthSensor] = (),  # applied to each image in this order
        table: TableView = "known",  # how the cloud contains the table, see `PlanningRules`
    ) -> Observation:
        """Observe the scene from each of the given poses, (4, 4) each."""
        workspace = np.asarray(self.fixed_parts.workspace)
        boxes = {"known": workspace, "seen": workspace - _ALOFT + _AROUND}
        box = boxes.get(table, _EVERYWHERE)
        clouds = []
        for T_world_camera in T_world_cameras:
            depth = self.world.render_depth(T_world_camera, CAMERA)
            for fault in faults:
                depth = fault.apply(depth, CAMERA, rng_noise)
            points = crop(unproject_to_world(depth, T_world_camera, CAMERA), box, _CROP_MARGIN)
            points = points + rng_noise.normal(0.0, noise_std, size=points.shape)
            clouds.append(crop(points, box).astype(np.float32, order="C"))
        whole = table not in boxes and len(clouds) == 1
        return Observation(
            cloud=np.concatenate(clouds),
            workspace=workspace.astype(np.float32),
            table_height=TABLE_HEIGHT,
            camera_positions=np.stack([T[:3, 3] for T in T_world_cameras]).astype(np.float32),
            view_ids=np.repeat(np.arange(len(clouds), dtype=np.int32), [len(c) for c in clouds]),
            table=table,
            pixels=np.flatnonzero(depth < FAR_SHARE * CAMERA.far) if whole else None,
        )

    def color_image(self, T_world_camera: Float64) -> NDArray[np.uint8]:
        """The scene in colour from a pose (4, 4): (H, W, 3), each object in a different colour."""
        depth = self.world.render_depth(T_world_camera, CAMERA)
        seen = depth < FAR_SHARE * CAMERA.far
        points, eye = unproject_to_world(depth, T_world_camera, CAMERA), T_world_camera[:3, 3]
        around = np.add(self.object_bounds, [[-0.003], [0.003]])
        inside = [((points > low) & (points < high)).all(axis=1) for low, high in around]
        row = np.flatnonzero(np.any(inside, axis=0))
        painted = np.full((len(points), 3), WOOD)
        for part in np.array_split(row, len(row) // 10_000 + 1):
            starts = np.tile(eye, (len(part), 1))  # rays end a little behind the visible points
            hits = self.world.first_hits(starts, starts + 1.01 * (points[part] - eye))
            for number, item in enumerate(self._objects):
                painted[part[np.equal(hits, item.body.uid)]] = PAINTS[number % len(PAINTS)]
        light = shaded(np.where(seen, depth, np.nan), CAMERA.focal_length, CAMERA.focal_length)
        image = np.full((*depth.shape, 3), 255.0)
        image[seen] = painted * (0.45 + 0.55 * light[seen][:, None])
        return image.astype(np.uint8)

    def try_grasp(
        self, T_world_hand: ArrayLike, *, shake: bool = False, to_the_end: bool = False
    ) -> GraspResult:
        """Simulate a grasp, (4, 4) of the `panda_hand` link, and restore the scene.

        Unless `to_the_end`, it ends once its outcome is clear, which is twice as fast and changes
        the outcome of 1 in 100 grasps.
        """
        result = self._run(T_world_hand, to_the_end=to_the_end, shake=shake)
        self._restore_rest()
        return result

    def execute_grasp(
        self, T_world_hand: ArrayLike, motion: ArmTrajectory | None = None
    ) -> GraspResult:
        """Grasp, remove a held object, let others rest; ValueError unless the pose is rigid."""
        self._hand.motion = motion
        result = self._run(T_world_hand, to_the_end=True, shake=False)
        self._rest_state = None
        self._hand.park()
        if result.held is not None:
            result.held.body.remove()
            self._objects.remove(result.held)
        self._objects = settle(self.world, self._objects, self.fixed_parts)
        return result

    def _add_gripper(self) -> HandDriver:
        if self.arm is None:
            return HandDriver(self.world, self.hand, self.min_opening)
        return ArmDriver(self.world, self.hand, self.arm, self.min_opening)

    @property
    def _hand(self) -> HandDriver:
        if self._gripper is None:
            raise RuntimeError("there is no scene yet; call reset or reset_from_poses first")
        return self._gripper

    def _run(self, T_world_hand: ArrayLike, *, to_the_end: bool, shake: bool) -> GraspResult:
        T = require_pose(T_world_hand)
        self._restore_rest()
        objects = {item.body.uid: item for item in self._objects}
        return run_grasp(
            self._hand, T, objects, self._obstacles, to_the_end=to_the_end, shake=shake
        )

    def _restore_rest(self) -> None:
        # Every grasp starts from the same saved state, so that earlier grasps have no effect.
        if self._rest_state is None:
            self._rest_state = self.world.save_state()
        # The engine keeps contact caches when it restores; moving all bodies apart empties them.
        for index, item in enumerate(self._objects):
            item.body.set_pose((5.0 + 5.0 * index, 0.0, 9.0), (0.0, 0.0, 0.0, 1.0))
        self._hand.park()
        self.world.detect_collisions()
        self.world.restore_state(self._rest_state)

    def _clear(self, fixed_parts: FixedParts) -> FixedParts:
        self.world.reset()
        self._objects = []
        self._gripper = None
        self._rest_state = None
        self.fixed_parts = fixed_parts
        self._obstacles = fixed_parts.add_to(self.world)
        return fixed_parts
