// The arm that executes a grasp, with its joints from /v1/robots, at rest and in motion.

import * as THREE from "./vendor/three.module.min.js";

const FAR = 0.5; // metres from its base to the middle of the objects
const THICK = 0.03; // metres, radius of a link as it is drawn
const LOOK = new THREE.MeshStandardMaterial({ color: "#c9d3e3", transparent: true, opacity: 0.75 });

export class Arm extends THREE.Group {
  /** An arm in the cloud's frame; `T_base_cloud` is 16 numbers, row by row; `hand` is drawn at its end. */
  constructor(robot, T_base_cloud, hand) {
    super();
    this.robot = robot;
    this.joints = [];
    new THREE.Matrix4().set(...T_base_cloud).invert().decompose(this.position, this.quaternion, this.scale);
    let last = this;
    for (let at = 0; at < robot.frames.length; at += 16) {
      const [frame, joint] = [new THREE.Group(), new THREE.Group()];
      new THREE.Matrix4().set(...robot.frames.slice(at, at + 16)).decompose(frame.position, frame.quaternion, frame.scale);
      last.add(link(frame.position), frame.add(joint));
      this.joints.push((last = joint));
    }
    last.add(hand);
  }

  /** Move to these joint values. */
  bend(joints) {
    joints.forEach((value, row) => {
      const axis = new THREE.Vector3().fromArray(this.robot.axes, 3 * row);
      if (this.robot.sliding[row]) this.joints[row].position.copy(axis.multiplyScalar(value));
      else this.joints[row].quaternion.setFromAxisAngle(axis, value);
    });
  }

  /** Play a motion at the arm's speed; `draw` renders each frame. */
  play({ times, positions }, draw) {
    const start = performance.now();
    const playing = (this.playing = Symbol()); // an earlier motion stops
    const step = () => {
      if (this.playing !== playing || !this.parent) return;
      const seconds = (performance.now() - start) / 1000;
      const next = times.findIndex((time) => time > seconds);
      this.bend(positions[next < 0 ? positions.length - 1 : next]);
      draw();
      if (next >= 0) requestAnimationFrame(step);
    };
    step();
  }
}

/** The link from a joint to the next joint, whose position is `end`. */
function link(end) {
  const length = end.length();
  const mesh = new THREE.Mesh(new THREE.CapsuleGeometry(THICK, length), LOOK);
  mesh.position.copy(end).multiplyScalar(0.5);
  if (length) mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), end.clone().normalize());
  return mesh;
}

/** T_base_cloud, row by row, of a base on the support, next to the objects and on the camera's side. */
export function beside({ objects, support, up: upward }, eye) {
  const up = new THREE.Vector3(...upward);
  const middle = objects.reduce((sum, { center }) => sum.add(new THREE.Vector3(...center)), new THREE.Vector3());
  middle.divideScalar(objects.length);
  const out = new THREE.Vector3(...eye).sub(middle).projectOnPlane(up).normalize();
  if (support) {
    const normal = new THREE.Vector3(...support.normal);
    middle.addScaledVector(normal, support.offset - middle.dot(normal));
  }
  const ahead = out.clone().negate();
  const pose = new THREE.Matrix4().makeBasis(ahead, up.clone().cross(ahead), up);
  return pose.setPosition(middle.addScaledVector(out, FAR)).invert().transpose().toArray();
}
