"""MuJoCo, which has wheels for every current Python and renders an image in milliseconds."""

import itertools
import os
from collections.abc import Sequence
from contextlib import AbstractContextManager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

os.environ.setdefault("MUJOCO_GL", "egl")  # read on import; images need no display

import mujoco
import numpy as np

from edgegrasp_camera.arrays import Float64
from edgegrasp_sim import engine
from edgegrasp_sim.engine import Contact, HandModel, SimCamera, Vector
from edgegrasp_sim.engine.urdf import read_urdf
from edgegrasp_sim.poses import about_z, quaternion_xyzw, translation

SUBSTEPS = 4  # of 3.125 ms in each time step
ARM_SUBSTEPS = 13  # with an arm, whose stiff joints need more than 1 kHz
JOINT_INERTIA = 0.5  # kg m² or kg, of a joint's drive
JOINT_STIFFNESS = 20000.0  # N m/rad or N/m, of its controller
JOINT_DAMPING = 400.0  # N m s/rad, about critical
CONTACT_SECONDS = 0.00625  # time constant of contacts; at least two substeps
IMPEDANCE = (0.95, 0.99, 0.001, 0.5, 2.0)  # of contacts, see MuJoCo's `solimp`
COLLISION_DEPTH = 0.0002  # metres; overlap of the hand with a hard body at about 100 N
FRICTION_IMPEDANCE = 10.0  # ratio of friction to normal impedance; keeps held objects from creeping
ARM_INERTIA = 1.0  # kg and kg m², of the arm behind the hand
ARM_STIFFNESS = 30000.0  # N/m and N m/rad
# Metres: the ratio of the torque about a contact's normal to its force. For a pad of 1 cm radius it
# is two thirds of the radius times the friction.
FINGER_SPINNING_FRICTION = 0.005
FINGER_SPEED = 0.2  # m/s, of a finger that nothing stops
FINGER_INERTIA = 0.3  # kg, of a finger's drive
FINGER_DAMPING = 400.0  # N s/m, with which the drive keeps to its speed
_SHARES = np.arange(1, SUBSTEPS + 1)[:, None] / SUBSTEPS
_HAND = 2  # bit of a hand's shapes, which collide only with shapes of bit 1, MuJoCo's default
# Without this, MuJoCo would merge links that no joint moves, and strip the paths of meshes.
_URDF_AS_IT_IS = (
    '<mujoco><compiler fusestatic="false" strippath="false" discardvisual="true"/></mujoco></robot>'
)
_VISIBLE, _SOLID = 0, 3  # groups of shapes: visible to the camera, and hit by rays


class MujocoWorld(AbstractContextManager["MujocoWorld"]):
    """A model, recompiled whenever bodies are added or removed, and its state.

    A process may have several worlds. Removed bodies cannot be restored.
    """

    name = "mujoco"
    constants: ClassVar = {  # of this engine, recorded in results
        "substeps": SUBSTEPS,
        "contact_seconds": CONTACT_SECONDS,
        "friction_impedance": FRICTION_IMPEDANCE,
        "arm_inertia": ARM_INERTIA,
        "arm_stiffness": ARM_STIFFNESS,
        "finger_spinning_friction": FINGER_SPINNING_FRICTION,
        "finger_speed": FINGER_SPEED,
        "finger_inertia": FINGER_INERTIA,
    }
    collision_depth = COLLISION_DEPTH  # metres; a finger sliding along an object overlaps by less
    # How a holding hand is shaken along x and y: metres to either side, and metres in each time
    # step. At 0.4 m/s the hand can follow, and reverses sharply.
    shake_distance, shake_step = 0.01, 0.005

    def __init__(self) -> None:
        self._drawn: Any = None  # the model that scene and context were made for
        self._scene: Any = None
        self._context: Any = None
        self.reset()

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the rendering context. Safe to call twice."""
        if self._context is not None:
            self._context.free()
        self._drawn = self._scene = self._context = None

    def reset(self) -> None:
        """Remove every body."""
        self.spec = spec = mujoco.MjSpec()
        spec.compiler.usethread = 0  # for so few meshes, threads cost more than they save
        spec.option.timestep = engine.TIME_STEP / SUBSTEPS
        spec.option.gravity = (0.0, 0.0, -engine.GRAVITY)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP  # resting bodies cost nothing
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = FRICTION_IMPEDANCE
        spec.default.geom.solref = (CONTACT_SECONDS, 1.0)
        spec.default.geom.solimp = IMPEDANCE
        spec.visual.quality.offsamples = 0
        spec.visual.quality.shadowsize = 0
        spec.stat.extent = 1.0
        self._model: Any = spec.compile()
        self._data: Any = mujoco.MjData(self._model)
        self.changed = False
        self._names = map(str, itertools.count())  # of bodies
        self._hand: MujocoHand | None = None
        self.substeps = SUBSTEPS
        self.uid_of_geom: list[int] = []
        self._places: dict[int, tuple[Float64, Float64]] = {}

    @property
    def data(self) -> Any:
        """The state, after recompiling the model if bodies have changed."""
        if self.changed:
            self.changed = False
            self._model, self._data = self.spec.recompile(self._model, self._data)
            names = [self._model.body(body).name for body in self._model.geom_bodyid]
            self.uid_of_geom = [int(name.split()[0]) for name in names]
            self._places.clear()
        return self._data

    def joint_state_of(self, uid: int) -> tuple[Float64, Float64]:
        """Positions and velocities of a body's joints and its links': views of the state."""
        data = self.data
        if uid not in self._places:
            model = self._model
            tree = model.body_treeid[model.body(str(uid)).id]
            first, last = model.tree_dofadr[tree], model.tree_dofadr[tree] + model.tree_dofnum[tree]
            start = model.jnt_qposadr[model.dof_jntid[first]]
            floats = model.jnt_type[model.dof_jntid[first]] == mujoco.mjtJoint.mjJNT_FREE
            # A floating body has position and quaternion wxyz, followed by its links' joints.
            end = start + last - first + int(floats)
            self._places[uid] = (data.qpos[start:end], data.qvel[first:last])
        return self._places[uid]

    def step(self, steps: int = 1) -> None:
        """Advance the world by `steps` time steps of 1/80 s."""
        model, data, hand = self.data.model, self.data, self._hand
        for _ in range(steps):
            if hand is None or hand.way is None:
                mujoco.mj_step(model, data, self.substeps)
                continue
            for place in hand.way:
                hand.goal[:] = place
                mujoco.mj_step(model, data)
                hand.after_substep()
            hand.way = None

    def first_hits(self, starts: Float64, ends: Float64) -> list[int]:
        """The body that each ray hits first, -1 for none; (R, 3) metres each, world frame."""
        model, data = self.data.model, self.data
        solid = np.arange(6) == _SOLID
        hits, geom = [], np.empty(1, np.int32)
        for start, end in zip(starts, ends, strict=True):
            share = mujoco.mj_ray(model, data, start, end - start, solid, 1, -1, geom)
            hits.append(self.uid_of_geom[geom[0]] if 0 <= share <= 1 else -1)
        return hits

    def detect_collisions(self) -> None:
        """Refresh the contact points without advancing time."""
        mujoco.mj_forward(self.data.model, self.data)

    def save_state(self) -> Any:
        """Keep the present state until `reset`; valid for the present bodies only."""
        kept = mujoco.MjData(self.data.model)
        mujoco.mj_copyData(kept, self.data.model, self.data)
        return kept

    def restore_state(self, state: Any) -> None:
        """Return to a saved state."""
        mujoco.mj_copyData(self.data, self.data.model, state)
        if self._hand is not None:
            self._hand.way = None

    def load_urdf(
        self, path: Path, position: Vector, quaternion_xyzw: Vector, scale: float
    ) -> "MujocoBody":
        """Load an object with its link frame at a pose; inertia comes from its collision shape."""
        shape = read_urdf(path, scale)
        body = self._add(np.asarray(position), quaternion_xyzw)
        body.add_freejoint()
        corners = np.concatenate([hull.points for hull in shape.hulls])
        _set_box_inertia(body, engine.OBJECT_MASS, corners)
        kind, shell = mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        for number, surface in enumerate(shape.visible):
            name = f"{body.name} visible {number}"  # visible to the camera, without collisions
            points, faces = surface.points.ravel(), surface.faces.ravel().astype(np.int32)
            self.spec.add_mesh(name=name, uservert=points, userface=faces, inertia=shell)
            body.add_geom(type=kind, meshname=name, contype=0, conaffinity=0, group=_VISIBLE)
        for number, hull in enumerate(shape.hulls):
            friction = (engine.OBJECT_FRICTION, 0, 0)
            self._add_hull(body, f"{body.name} {number}", hull.points, friction=friction)
        added = MujocoBody(self, body, corners)
        added.set_pose(position, quaternion_xyzw)
        added.set_pose(np.asarray(position) + added.rotation @ shape.centre, quaternion_xyzw)
        return added

    def add_box(
        self, size: Vector, centre: Vector, *, friction: float, yaw: float = 0.0
    ) -> "MujocoBody":
        """Add a box that never moves, rotated about z; `size` is its full extent in metres."""
        kind, half = mujoco.mjtGeom.mjGEOM_BOX, 0.5 * np.asarray(size)
        body = self._add(np.asarray(centre), about_z(yaw))
        # Its friction counts, not the object's.
        body.add_geom(type=kind, size=half, friction=(friction, 0, 0), priority=1, group=_SOLID)
        body.add_geom(type=kind, size=half, contype=0, conaffinity=0, group=_VISIBLE)
        signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
        return MujocoBody(self, body, signs * half)

    def add_hand(self, model: HandModel, position: Float64) -> "MujocoHand":
        """Add an open hand with its centre of mass at a position; a world may have one."""
        body = self._add(np.asarray(position), (0.0, 0.0, 0.0, 1.0))
        body.add_freejoint().armature = ARM_INERTIA
        palm = self._build_hand(body, model)
        # Springs of limited force along all six axes pull the hand to the pose of a target.
        self.spec.worldbody.add_body(name="-1 target", mocap=True).add_site(name="target")
        body.add_site(name="hand")
        damping = 2.0 * (ARM_STIFFNESS * (ARM_INERTIA + body.mass)) ** 0.5
        to_target = {"trntype": mujoco.mjtTrn.mjTRN_SITE, "target": "hand", "refsite": "target"}
        for axis, gear in enumerate(np.eye(6)):
            spring = self._drive(f"arm {axis}", model.tool_force, gear=gear, **to_target)
            spring.set_to_position(ARM_STIFFNESS, damping)
        self._hand = MujocoHand(self, body, palm, model)
        self._hand.set_pose(position, (0.0, 0.0, 0.0, 1.0))
        return self._hand

    def add_arm(self, arm: engine.ArmModel, model: HandModel) -> "MujocoArm":
        """Add an arm in its home position with an open hand."""
        self.substeps = ARM_SUBSTEPS
        self.spec.option.timestep = engine.TIME_STEP / ARM_SUBSTEPS
        added = mujoco.MjSpec.from_string(arm.urdf.replace("</robot>", _URDF_AS_IT_IS))
        for body in added.bodies[1:]:
            body.gravcomp = 1.0
            for geom in body.geoms:
                geom.contype, geom.group = _HAND, _SOLID
                geom.solref, geom.solimp = (CONTACT_SECONDS, 1.0), IMPEDANCE
        name = next(self._names)
        turn = np.roll(quaternion_xyzw(arm.T_world_root), 1)  # MuJoCo's w comes first
        place = self.spec.worldbody.add_frame(pos=arm.T_world_root[:3, 3], quat=turn)
        self.spec.attach(added, prefix=f"{name} ", frame=place)
        flange = self.spec.body(f"{name} {arm.flange}")
        T_flange_body = arm.T_flange_hand @ translation(*model.centre)
        turn = np.roll(quaternion_xyzw(T_flange_body), 1)
        body = flange.add_body(name=name, pos=T_flange_body[:3, 3], quat=turn)
        palm = self._build_hand(body, model)
        for joint in arm.joint_names:
            self.spec.joint(f"{name} {joint}").armature = JOINT_INERTIA
            self._drive(f"{name} {joint}").set_to_position(JOINT_STIFFNESS, JOINT_DAMPING)
        self.changed = True
        self._hand = added_arm = MujocoArm(self, body, palm, model)
        added_arm.home = np.asarray(arm.home)
        added_arm.rest()
        return added_arm

    def _build_hand(self, body: Any, model: HandModel) -> Float64:
        """Add palm and fingers to a body; returns the palm's corners (P, 3)."""
        body.gravcomp = 1.0
        palm = [part - model.centre for part in model.palm]
        _set_box_inertia(body, model.mass, np.concatenate(palm))
        for number, part in enumerate(palm):
            name = f"{body.name} palm {number}"
            self._add_hull(body, name, part, friction=(model.friction, 0, 0), contype=_HAND)
        pads = (model.finger_friction, FINGER_SPINNING_FRICTION, 0)
        contact = {"friction": pads, "condim": 4, "priority": 2, "contype": _HAND}
        carrier = body
        if model.advance is not None:  # swinging fingers are on a carriage that slides along z
            carrier = body.add_body(name=f"{body.name} slide", gravcomp=1.0)
            carrier.explicitinertial = True
            carrier.mass, carrier.inertia = engine.SLIDE_MASS, [1e-5] * 3
            kind, along = mujoco.mjtJoint.mjJNT_SLIDE, (0.0, 0.0, 1.0)
            carrier.add_joint(name=carrier.name, type=kind, axis=along, armature=FINGER_INERTIA)
        for side, parts in zip((1.0, -1.0), model.fingers, strict=True):
            base = np.array([0.0, 0.0, model.finger_base]) - model.centre
            name = f"{body.name} finger {side:+.0f}"
            finger = carrier.add_body(name=name, pos=base, gravcomp=1.0)
            _set_box_inertia(finger, model.finger_mass, np.concatenate(parts))
            finger.add_joint(
                name=finger.name,
                type=mujoco.mjtJoint.mjJNT_SLIDE,
                axis=(0.0, side, 0.0),
                range=(0.0, 0.5 * model.max_opening),
                armature=FINGER_INERTIA,
                solref_limit=(CONTACT_SECONDS, 1.0),
                solimp_limit=IMPEDANCE,
            )
            for number, part in enumerate(parts):
                self._add_hull(finger, f"{finger.name} {number}", part, **contact)
            self._drive(finger.name, model.finger_force).set_to_velocity(FINGER_DAMPING)
        *slide, one, other = (joint.name for joint in body.find_all("joint") if joint.name)
        self._couple(one, other, (0.0, 1.0))
        if model.advance is not None:
            self._couple(slide[0], one, model.advance)
        return np.concatenate(palm)

    def render_depth(self, T_world_camera: Float64, camera: SimCamera) -> Float64:
        """Depth (height, width) at the pixels' lower left corners, metres; `far` if empty."""
        _gl_context(camera.width, camera.height)
        model, data = self.data.model, self.data
        if self._drawn is not model:
            self.close()
            self._drawn = model
            self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 1)
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
            self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        scene, everything = self._scene, mujoco.mjtCatBit.mjCAT_ALL.value
        option, free = mujoco.MjvOption(), mujoco.MjvCamera()
        option.geomgroup[:] = np.arange(len(option.geomgroup)) == _VISIBLE
        mujoco.mj_kinematics(model, data)
        mujoco.mjv_updateScene(model, data, option, None, free, everything, scene)
        scene.flags[:] = 0  # no lights, and both sides of every surface
        scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = 1
        # OpenGL's camera samples pixel centres.
        near, far, per_pixel = camera.near, camera.far, camera.near / camera.focal_length
        centre_x, centre_y = camera.centre_x + 0.5, camera.centre_y - 0.5
        for eye in scene.camera:
            eye.pos, eye.forward = T_world_camera[:3, 3], T_world_camera[:3, 2]
            eye.up = -T_world_camera[:3, 1]
            eye.frustum_center = (0.5 * camera.width - centre_x) * per_pixel
            eye.frustum_width = 0.5 * camera.width * per_pixel
            eye.frustum_top = centre_y * per_pixel
            eye.frustum_bottom = (centre_y - camera.height) * per_pixel
            eye.frustum_near, eye.frustum_far = near, far
            eye.orthographic = 0
        image = np.empty((camera.height, camera.width), np.float32)
        frame = mujoco.MjrRect(0, 0, camera.width, camera.height)
        mujoco.mjr_render(frame, scene, self._context)
        mujoco.mjr_readPixels(None, image, frame, self._context)
        # Rows go up; depths go from 1 (near) to 0 (far or empty).
        return near * far / (near + (far - near) * image[::-1].astype(np.float64))

    def _add(self, position: Float64, quaternion_xyzw: Vector) -> Any:
        self.changed = True
        turn = np.roll(quaternion_xyzw, 1)
        return self.spec.worldbody.add_body(name=next(self._names), pos=position, quat=turn)

    def _add_hull(self, body: Any, name: str, points: Float64, **contact: Any) -> None:
        """Add the convex hull of points (P, 3) for contacts."""
        self.spec.add_mesh(name=name, uservert=points.ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, group=_SOLID, **contact)

    def _drive(self, name: str, force: float | None = None, **moved: Any) -> Any:
        """Add a drive of limited force, by default for the joint of the same name."""
        joint = {"trntype": mujoco.mjtTrn.mjTRN_JOINT, "target": name}
        drive = self.spec.add_actuator(name=name, **moved or joint)
        if force is not None:
            drive.forcelimited, drive.forcerange = True, (-force, force)
        return drive

    def _couple(self, joint: str, other: str, polynomial: Sequence[float]) -> None:
        """Couple a joint to another's position by a polynomial."""
        self.spec.add_equality(
            type=mujoco.mjtEq.mjEQ_JOINT,
            name1=joint,
            name2=other,
            data=[*polynomial, *(12 - len(polynomial)) * [0.0]],
            solref=(CONTACT_SECONDS, 1.0),
            solimp=IMPEDANCE,
        )


class MujocoBody:
    """A body of a model. Its pose is that of its centre of mass."""

    def __init__(self, world: MujocoWorld, body: Any, points: Float64) -> None:
        self.world, self.points, self._body = world, points, body
        self.uid = int(body.name)

    def remove(self) -> None:
        """Remove the body from its world."""
        spec, body = self.world.spec, self._body
        names = [geom.meshname for geom in body.geoms if geom.meshname]
        spec.delete(body)
        for name in names:
            spec.delete(spec.mesh(name))
        self.world.changed = True

    @property
    def position(self) -> Float64:
        """Centre of mass, world frame, metres: (3,)."""
        return self.world.joint_state_of(self.uid)[0][:3].copy()

    @property
    def quaternion_xyzw(self) -> tuple[float, float, float, float]:
        """Orientation in the world frame."""
        w, x, y, z = self.world.joint_state_of(self.uid)[0][3:7].tolist()
        return x, y, z, w

    @property
    def rotation(self) -> Float64:
        """Its rotation matrix in the world frame, (3, 3)."""
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, self.world.joint_state_of(self.uid)[0][3:7])
        return matrix.reshape(3, 3)

    def set_pose(self, position: Vector, quaternion_xyzw: Vector) -> None:
        """Set the pose of the centre of mass, at rest."""
        x, y, z, w = quaternion_xyzw
        qpos, qvel = self.world.joint_state_of(self.uid)
        qpos[:7] = (*position, w, x, y, z)
        qvel[:] = 0.0

    @property
    def speed(self) -> float:
        """Norm of the linear (m/s) and angular (rad/s) velocities together."""
        return float(np.linalg.norm(self.world.joint_state_of(self.uid)[1]))

    @property
    def bounds(self) -> Float64:
        """Lowest and highest corner of its axis-aligned bounding box: (2, 3) metres."""
        corners = self.points @ self.rotation.T + self.position
        return np.stack((corners.min(axis=0), corners.max(axis=0)))

    def contacts(self) -> list[Contact]:
        """The contact points found by the last step or collision detection."""
        found, uids = self.world.data.contact, self.world.uid_of_geom
        rows = zip(found.geom.tolist(), found.dist.tolist(), found.pos.tolist(), strict=True)
        return [
            Contact(uids[other if uids[one] == self.uid else one], distance, position)
            for (one, other), distance, position in rows
            if self.uid in (uids[one], uids[other])
        ]


class MujocoHand(MujocoBody):
    """The palm, which springs of limited force pull to a target, with two motorised fingers."""

    def __init__(self, world: MujocoWorld, body: Any, points: Float64, model: HandModel) -> None:
        super().__init__(world, body, points)
        self.hand = model
        self.way: Float64 | None = None  # (substeps, D) values of `goal` in the next time step
        self.goal: Float64 = np.empty(0)  # (D,) view of the state: the position of the target

    @property
    def opening(self) -> float:
        """Metres between the fingers."""
        one, other = self.world.joint_state_of(self.uid)[0][-2:].tolist()
        return float(one + other)

    def set_pose(self, position: Vector, quaternion_xyzw: Vector) -> None:
        """Set the hand's pose at once, open and at rest, and hold it there."""
        super().set_pose(position, quaternion_xyzw)
        data = self.world.data
        joints = self.world.joint_state_of(self.uid)[0][7:]
        joints[:-2], joints[-2:] = 0.0, 0.5 * self.hand.max_opening
        data.ctrl[:2] = FINGER_SPEED
        data.mocap_pos[0] = position
        self.move(position, quaternion_xyzw)
        self.way = None

    def move(self, position: Vector, quaternion_xyzw: Vector) -> None:
        """Pull the centre of mass to a pose in the next step."""
        x, y, z, w = quaternion_xyzw
        data = self.world.data
        self.goal = data.mocap_pos[0]
        self.way = self.goal + _SHARES * (np.asarray(position) - self.goal)
        data.mocap_quat[0] = (w, x, y, z)

    def close_fingers(self) -> None:
        """Drive the fingers together with full force from now on."""
        self.world.data.ctrl[:2] = -FINGER_SPEED

    def after_substep(self) -> None:
        """Called after each substep; a floating hand records nothing."""


class MujocoArm(MujocoHand):
    """A hand on an arm, which is moved by its joints and not by setting its pose.

    Its contacts are those of all links in all substeps of the last time step.
    """

    substeps = ARM_SUBSTEPS  # of a time step
    home: Float64  # (J,)
    _found: tuple[Contact, ...] = ()

    @property
    def position(self) -> Float64:
        """The same as for other bodies; `places` of an arm begins with its joints."""
        return np.array(self.world.data.body(str(self.uid)).xpos)

    def rest(self) -> None:
        """Set the arm to its home position at once, at rest, with an open hand."""
        joints, velocities = self.world.joint_state_of(self.uid)
        data, count = self.world.data, len(self.home)
        joints[:count], joints[count:-2], joints[-2:] = self.home, 0.0, self.hand.max_opening / 2
        velocities[:] = 0.0
        data.ctrl[:2], data.ctrl[2 : 2 + count] = FINGER_SPEED, self.home
        self.way, self._found = None, ()

    def drive(self, positions: Float64, velocities: Float64) -> None:
        """Let the joints' controllers follow (substeps, J) in the next time step."""
        self.goal = self.world.data.ctrl[2 : 2 + len(self.home)]
        self.way = positions + JOINT_DAMPING / JOINT_STIFFNESS * velocities
        self._found = ()

    def after_substep(self) -> None:
        """Keep the contacts of the last substep."""
        self._found += tuple(super().contacts())

    def contacts(self) -> list[Contact]:
        """The contacts of the last time step; at home, those found by collision detection."""
        return list(self._found) or super().contacts()

    def close_fingers(self) -> None:
        """Drive the fingers together, and forget earlier contacts."""
        super().close_fingers()
        self._found = ()


@cache
def _gl_context(width: int, height: int) -> Any:
    """The OpenGL context of this process, created once."""
    try:
        # MuJoCo chooses when it is imported, perhaps before MUJOCO_GL was set.
        drawing = import_module(f"mujoco.{os.environ['MUJOCO_GL'].lower()}")
        context = drawing.GLContext(width, height)
        context.make_current()
    except Exception as error:  # ctypes, OpenGL and EGL raise many kinds of errors
        raise OSError(
            f"MuJoCo cannot draw images with MUJOCO_GL={os.environ['MUJOCO_GL']}: {error}; on "
            "Debian and Ubuntu: apt-get install libegl1 libgl1"
        ) from error
    return context


def _set_box_inertia(body: Any, mass: float, corners: Float64) -> None:
    """Give a body the inertia of the bounding box of its points (P, 3), as PyBullet does."""
    x, y, z = np.square(np.ptp(corners, axis=0))
    body.explicitinertial = True
    body.mass, body.ipos = mass, np.zeros(3)
    body.inertia = mass / 12.0 * np.array([y + z, x + z, x + y])
