// The picture: the cloud, the answer, and the shapes that the mouse edits.
//
// `root` contains everything; it is rotated so that the cloud's up direction points up in the picture.

import * as THREE from "./vendor/three.module.min.js";
import { OrbitControls } from "./vendor/OrbitControls.js";
import { Arm } from "./arm.js";
import { TransformControls } from "./vendor/TransformControls.js";

const UP = new THREE.Vector3(0, 0, 1);
const MOST_POINTS = 500_000; // drawn; more would only hide each other
const STEM = 0.04; // metres drawn behind the palm
const NEAR = 10; // pixels; a click selects a hand or a point within this distance
const CONE = 0.12; // metres, length of the approach cone
const FRUSTUM = 0.06; // metres, length of the camera's pyramid
const AXES = 0.1; // metres, length of the cloud's axes
const HUES = { region: "#4cc9f0", workspace: "#f4f4f5", cone: "#ff9f1c" };
const BOX = new THREE.BoxGeometry(1, 1, 1);
const EDGES = new THREE.EdgesGeometry(BOX);
const DARK = new THREE.LineBasicMaterial({ color: "#0a0d13" }); // hands stand out from objects of any colour

/** The colour of a score from 0 to 1: cyan to magenta, which objects rarely have. */
export function colorOf(score) {
  const share = Math.min(Math.max(score, 0), 1);
  return new THREE.Color().setRGB(share, 1 - share, 1, THREE.SRGBColorSpace);
}

/** Position and quaternion x, y, z, w of a pose (4, 4). */
export function partsOf(pose) {
  const [position, quaternion] = [new THREE.Vector3(), new THREE.Quaternion()];
  new THREE.Matrix4().set(...pose.flat()).decompose(position, quaternion, new THREE.Vector3());
  return { position: position.toArray(), quaternion: quaternion.toArray() };
}

/** The picture, which fills `stage`. `tell` has functions: picked(row | null), edited(shape's name),
 * drawn(points), aimed(place | null) and object(number). */
export class View {
  constructor(stage, tell) {
    this.stage = stage;
    this.tell = tell;
    this.renderer = new THREE.WebGLRenderer({ antialias: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setClearColor("#0e131b");
    this.canvas = this.renderer.domElement;
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("aria-label", "the scene: drag to turn, arrow keys to move, wheel to zoom");
    stage.prepend(this.canvas);
    this.camera = new THREE.PerspectiveCamera(45, 1, 0.01, 50);
    this.camera.up.copy(UP);
    this.world = new THREE.Scene();
    this.root = new THREE.Group();
    const sun = new THREE.DirectionalLight("white", 1.6);
    sun.position.set(0.5, -1, 2);
    this.world.add(this.root, new THREE.HemisphereLight("white", "#556", 2.2), sun);
    this.groups = {};
    for (const name of ["cloud", "frame", "plane", "objects", "hands", "chosen", "rejected", "arm"]) {
      this.root.add((this.groups[name] = new THREE.Group()));
    }
    this.shapes = {};
    this.pointSize = 2;
    this.orbit = new OrbitControls(this.camera, this.canvas);
    this.orbit.listenToKeyEvents(this.canvas);
    this.orbit.addEventListener("change", () => this.draw());
    this.gizmo = new TransformControls(this.camera, this.canvas);
    this.gizmo.setSpace("local");
    this.gizmo.setSize(0.7);
    this.gizmo.addEventListener("change", () => this.draw());
    this.gizmo.addEventListener("dragging-changed", ({ value }) => (this.orbit.enabled = !value));
    this.gizmo.addEventListener("objectChange", () => tell.edited(this.gizmo.object.name));
    this.world.add(this.gizmo.getHelper());
    this._listen();
    new ResizeObserver(() => this._resize()).observe(stage);
    this._resize();
  }

  /** Draw the next frame; many calls before it draw it once. */
  draw() {
    this._due ??= requestAnimationFrame(() => this._render());
  }

  _render() {
    this._due = null;
    this.renderer.render(this.world, this.camera);
    this._placeLabels();
  }

  /** The picture as a PNG file. */
  picture() {
    this._render(); // a canvas can be read only in the task that drew it
    return new Promise((done) => this.canvas.toBlob(done));
  }

  _resize() {
    const { clientWidth: width, clientHeight: height } = this.stage;
    if (!width || !height) return;
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  // The cloud

  /** Show another scene, from where its camera stood. */
  showScene(scene) {
    this.clear();
    const count = scene.points.length / 3;
    const step = Math.ceil(count / MOST_POINTS);
    const [places, shades] = [[], []];
    const grey = scene.colors ? null : greyOf(scene.points);
    for (let row = 0; row < count; row += step) {
      const place = scene.points.subarray(3 * row, 3 * row + 3);
      if (!place.every(Number.isFinite)) continue;
      places.push(...place);
      const shade = scene.colors ? scene.colors.subarray(3 * row, 3 * row + 3) : grey(place[2]);
      shades.push(...new THREE.Color().setRGB(...shade, THREE.SRGBColorSpace));
    }
    if (!places.length) throw new Error(`${scene.name}: has no points`);
    this.places = Float32Array.from(places);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(this.places, 3));
    geometry.setAttribute("color", new THREE.Float32BufferAttribute(shades, 3));
    const look = { vertexColors: true, sizeAttenuation: false };
    this.groups.cloud.add(new THREE.Points(geometry, new THREE.PointsMaterial(look)));
    this.setPointSize(this.pointSize);
    const half = Math.floor(places.length / 6); // typed arrays sort by number
    this.middle = [0, 1, 2].map((axis) => this.places.filter((_, i) => i % 3 === axis).sort()[half]);
    this.root.quaternion.setFromUnitVectors(
      scene.camera ? new THREE.Vector3(0, -1, 0) : UP, UP);
    this.root.updateMatrixWorld();
    this.eye = scene.camera ? [0, 0, 0] : scene.viewpoint;
    const { height, fy } = scene.camera ?? {};
    this.camera.fov = scene.camera ? (2 * Math.atan(height / 2 / fy) * 180) / Math.PI : 45;
    this.camera.updateProjectionMatrix();
    this._showFrame(scene);
    this.look("camera");
  }

  /** Show nothing. */
  clear() {
    this.groups.cloud.children[0]?.geometry.dispose();
    for (const group of Object.values(this.groups)) group.clear();
    [this.hands, this.target] = [[], null];
    this._showObjects([]);
  }

  /** Set the size of drawn points, in pixels. */
  setPointSize(size) {
    this.pointSize = size;
    const [points] = this.groups.cloud.children;
    if (points) points.material.size = size * this.renderer.getPixelRatio();
    this.draw();
  }

  /** The axes of the cloud's frame, x red, y green and z blue, and the camera. */
  _showFrame({ camera }) {
    this.groups.frame.add(new THREE.AxesHelper(AXES));
    if (!this.eye) return;
    const { width, height, fx, fy } = camera ?? { width: 5, height: 4, fx: 5, fy: 5 };
    const pyramid = new THREE.ConeGeometry(Math.SQRT1_2, 1, 4).rotateY(Math.PI / 4); // tip at 0, open toward z
    const edges = new THREE.EdgesGeometry(pyramid.translate(0, -0.5, 0).rotateX(-Math.PI / 2));
    const frustum = new THREE.LineSegments(edges, new THREE.LineBasicMaterial({ color: "#f4f4f5" }));
    frustum.scale.set(width / fx, height / fy, 1).multiplyScalar(FRUSTUM);
    frustum.position.set(...this.eye);
    if (!camera) frustum.lookAt(...this.middle);
    this.groups.frame.add(frustum);
  }

  /** Look at the objects from "camera", "top" or "side"; "camera" is an oblique view if its position is unknown. */
  look(from) {
    const target = this._outside(this.target ?? this.middle);
    const eye = this._outside(this.eye ?? [0, 0, 0]);
    const aside = eye.clone().sub(target).setZ(0); // most cameras and robots are on this side
    if (aside.length() < 0.1) aside.set(0.25, -0.7, 0);
    const far = Math.min(Math.max(1.9 * eye.distanceTo(target), 0.9), 1.5); // with the camera in view
    const [away, above] = { top: [0.001, far], side: [far, 0.02], camera: [0.75, 0.6] }[from];
    this.camera.position.copy(target).add(aside.setLength(away)).addScaledVector(UP, above);
    if (from === "camera" && this.eye) this.camera.position.copy(eye);
    this.orbit.target.copy(target);
    this.orbit.update();
    this.draw();
  }

  /** Transform a point from the cloud's frame to the picture's. */
  _outside(place) {
    return this.root.localToWorld(new THREE.Vector3(...place));
  }

  /** Project a point of the cloud's frame to pixels of the stage; z exceeds 1 behind the camera. */
  _pixel(place) {
    const { clientWidth: width, clientHeight: height } = this.stage;
    const { x, y, z } = this.root.localToWorld(place.clone()).project(this.camera);
    return { x: ((x + 1) / 2) * width, y: ((1 - y) / 2) * height, z };
  }

  // The answer

  /** Show the API's answer; if it is the first of this scene, look at its objects. */
  showAnswer(answer, gripper, first) {
    this.gripper = gripper;
    this.hands = answer.grasps.map((grasp) =>
      this._lines([grasp.T_cloud_hand], grasp.width, { color: colorOf(grasp.score) }));
    this.groups.hands.clear();
    for (const hand of this.hands) this.groups.hands.add(hand);
    this.groups.rejected.clear();
    this._showObjects(answer.objects);
    const middle = answer.objects.reduce((sum, { center }) => sum.add(new THREE.Vector3(...center)), new THREE.Vector3());
    this.target = answer.objects.length ? middle.divideScalar(answer.objects.length).toArray() : this.middle;
    this._showPlane(answer.support);
    this.root.quaternion.setFromUnitVectors(new THREE.Vector3(...answer.up), UP);
    this.root.updateMatrixWorld();
    if (first) this.look("camera");
    this.choose(null);
  }

  _showObjects(objects) {
    this.groups.objects.clear();
    this.labels = objects.map((object) => {
      const box = new THREE.LineSegments(EDGES, new THREE.LineBasicMaterial({ color: "#8fd694" }));
      box.position.set(...object.center);
      box.quaternion.set(...object.quaternion);
      box.scale.set(...object.half_extents).multiplyScalar(2);
      this.groups.objects.add(box);
      return box.position;
    });
    this.stage.querySelector(".labels").replaceChildren(...objects.map(({ number }) => {
      const label = Object.assign(document.createElement("button"), { type: "button", textContent: number, tabIndex: -1 });
      label.addEventListener("click", () => this.tell.object(number));
      return label;
    }));
  }

  _placeLabels() {
    const labels = this.stage.querySelectorAll(".labels button");
    (this.labels ?? []).forEach((place, row) => {
      const { x, y, z } = this._pixel(place);
      labels[row].hidden = z > 1 || !this.groups.objects.visible;
      labels[row].style.transform = `translate(${x}px, ${y}px)`;
    });
  }

  _showPlane(support) {
    this.groups.plane.clear();
    if (!support) return;
    const normal = new THREE.Vector3(...support.normal);
    const grid = new THREE.GridHelper(0.6, 12, "#6ea8fe", "#6ea8fe");
    Object.assign(grid.material, { transparent: true, opacity: 0.35 });
    grid.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), normal);
    const foot = new THREE.Vector3(...this.target);
    grid.position.copy(foot.addScaledVector(normal, support.offset - foot.dot(normal)));
    this.groups.plane.add(grid);
  }

  /** Hands at poses `T_cloud_hand` as thin lines: stem, palm, and the fingers at their opening. */
  _lines(poses, width, look) {
    const [half, palm, tip] = [width / 2, this.gripper.palm_z, this.gripper.tip_z + this._advance(width)];
    const ends = [[0, palm - STEM], [0, palm], [-half, palm], [half, palm], [-half, palm], [-half, tip],
      [half, palm], [half, tip]];
    const places = poses.flatMap((pose) =>
      ends.flatMap(([y, z]) => [0, 1, 2].map((row) => pose[row][1] * y + pose[row][2] * z + pose[row][3])),
    );
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(places, 3));
    return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial(look));
  }

  /** How far swinging fingertips advance along z compared with the open gripper, metres. */
  _advance(width) {
    const { swing, max_opening: open } = this.gripper;
    if (!swing) return 0;
    const { radius, reach } = swing;
    const outward = reach - (open - Math.min(Math.max(width, 0), open)) / 2;
    return Math.sqrt(radius ** 2 - outward ** 2) - Math.sqrt(radius ** 2 - reach ** 2);
  }

  /** The gripper's collision boxes at a grasp: the hand is transparent, the fingers are opaque. */
  _body(grasp, color) {
    const hand = new THREE.Group();
    const add = ([low, high], y, z, opacity) => {
      const look = { color, emissive: color, emissiveIntensity: 0.45, opacity, transparent: opacity < 1, depthWrite: opacity === 1 };
      for (const part of [new THREE.Mesh(BOX, new THREE.MeshStandardMaterial(look)), new THREE.LineSegments(EDGES, DARK)]) {
        part.position.set(...[0, y, z].map((shift, axis) => (low[axis] + high[axis]) / 2 + shift));
        part.scale.set(...low.map((value, axis) => high[axis] - value));
        hand.add(part);
      }
    };
    for (const box of this.gripper.hand.boxes) add(box, 0, 0, 0.15);
    const [half, ahead] = [grasp.width / 2, this._advance(grasp.width)];
    for (const [low, high] of this.gripper.finger.boxes) {
      add([low, high], half, ahead, 1);
      add([[low[0], -high[1], low[2]], [high[0], -low[1], high[2]]], -half, ahead, 1);
    }
    hand.applyMatrix4(new THREE.Matrix4().set(...grasp.T_cloud_hand.flat()));
    return hand;
  }

  /** Show the hands of these rows. */
  showHands(rows) {
    const shown = new Set(rows);
    this.hands.forEach((hand, row) => (hand.visible = shown.has(row)));
    this.draw();
  }

  /** Draw one grasp's hand, its approach and contact points and its approach direction; null: none. */
  choose(grasp) {
    const group = this.groups.chosen.clear();
    if (grasp) {
      const color = colorOf(grasp.score);
      const hand = this._body(grasp, color);
      const tail = new THREE.Vector3(0, 0, this.gripper.palm_z - STEM).applyMatrix4(hand.matrix);
      const way = new THREE.Vector3(...grasp.approach_direction);
      const arrow = new THREE.ArrowHelper(way, tail.addScaledVector(way, -0.08), 0.075, "white", 0.02, 0.012);
      group.add(hand, arrow, ...ends(grasp));
    }
    this.draw();
  }

  /** Draw an arm of /v1/robots in its home position; null: none. */
  showArm(robot, T_base_cloud) {
    this.groups.arm.clear();
    this.arm = null;
    if (robot) {
      const hand = this._body({ T_cloud_hand: new THREE.Matrix4().elements, width: this.gripper.max_opening }, "#c9d3e3");
      this.groups.arm.add((this.arm = new Arm(robot, T_base_cloud, hand)));
      this.bendArm(robot.home);
    }
    this.draw();
  }

  /** Move the arm to these joint values, and stop its motion. */
  bendArm(joints) {
    if (!this.arm) return;
    this.arm.playing = null;
    this.arm.bend(joints);
    this.draw();
  }

  playArm(motion) {
    this.arm?.play(motion, () => this.draw());
  }

  /** Show outlines of candidates: `T_cloud_hand` of each. */
  showRejected(poses) {
    const look = { color: "#ff6b6b", transparent: true, opacity: 0.45 };
    this.groups.rejected.clear().add(this._lines(poses, this.gripper.max_opening, look));
    this.draw();
  }

  show(name, visible) {
    this.groups[name].visible = visible;
    this.draw();
  }

  // Shapes to edit

  /** Show a box (center, half_extents, quaternion) or the cone (direction, max_angle); null: remove it. */
  setShape(name, shape) {
    if (this.shapes[name]) {
      if (this.gizmo.object === this.shapes[name]) this.gizmo.detach();
      this.shapes[name].removeFromParent();
      delete this.shapes[name];
    }
    if (shape) {
      const made = name === "cone" ? this._cone(shape) : boxShape(shape, HUES[name]);
      made.name = name;
      this.root.add((this.shapes[name] = made));
    }
    this.draw();
  }

  _cone({ direction, max_angle }) {
    const spread = Math.min(max_angle, 1.4);
    const surface = new THREE.ConeGeometry(CONE * Math.tan(spread), CONE, 40, 1, true);
    surface.rotateX(Math.PI / 2).translate(0, 0, -CONE / 2); // its tip at 0, open toward -z
    const look = { color: HUES.cone, transparent: true, opacity: 0.3, side: THREE.DoubleSide, depthWrite: false };
    const cone = new THREE.Mesh(surface, new THREE.MeshBasicMaterial(look));
    const start = new THREE.Vector3(0, 0, -1.4 * CONE);
    cone.add(new THREE.ArrowHelper(UP, start, 1.3 * CONE, HUES.cone, 0.03, 0.018));
    cone.position.set(...(this.target ?? this.middle));
    cone.quaternion.setFromUnitVectors(UP, new THREE.Vector3(...direction).normalize());
    return cone;
  }

  /** The current shape, in the form that `setShape` takes, but without the cone's angle. */
  shape(name) {
    const made = this.shapes[name];
    if (name === "cone") return { direction: UP.clone().applyQuaternion(made.quaternion).toArray() };
    return {
      center: made.position.toArray(),
      half_extents: made.scale.toArray().map((size) => Math.max(Math.abs(size) / 2, 0.001)),
      quaternion: made.quaternion.toArray(),
    };
  }

  /** Let the mouse move, resize or rotate a shape; null: none. */
  edit(name, mode) {
    if (name && this.shapes[name]) {
      this.gizmo.attach(this.shapes[name]);
      this.gizmo.setMode(mode);
    } else this.gizmo.detach();
    this.draw();
  }

  /** The box around points of the cloud's frame, along its axes, or along the picture's if `upright`. */
  boxAround(points, upright) {
    const turn = upright ? this.root.quaternion.clone() : new THREE.Quaternion();
    const box = new THREE.Box3();
    for (const point of points) box.expandByPoint(new THREE.Vector3(...point).applyQuaternion(turn));
    const back = turn.clone().invert();
    return {
      center: box.getCenter(new THREE.Vector3()).applyQuaternion(back).toArray(),
      half_extents: box.getSize(new THREE.Vector3()).toArray().map((size) => size / 2 + 0.005),
      quaternion: back.toArray(),
    };
  }

  // The mouse

  /** Let the next drag draw a rectangle, and pass the points in it to `tell.drawn`. */
  startDrawing() {
    this.drawing = true;
    this.orbit.enabled = false;
    this.stage.classList.add("drawing");
  }

  /** Let the next click select a point of the cloud, and pass it to `tell.aimed`. */
  startAiming(on) {
    this.aiming = on;
    this.stage.classList.toggle("drawing", on);
  }

  _listen() {
    const band = this.stage.querySelector(".band");
    let from = null;
    const place = ({ offsetX, offsetY }) => [offsetX, offsetY];
    this.canvas.addEventListener("pointerdown", (event) => (from = place(event)));
    this.canvas.addEventListener("pointermove", (event) => {
      if (!this.drawing || !from) return;
      const to = place(event);
      Object.assign(band.style, { left: `${Math.min(from[0], to[0])}px`, top: `${Math.min(from[1], to[1])}px`,
        width: `${Math.abs(to[0] - from[0])}px`, height: `${Math.abs(to[1] - from[1])}px` });
      band.hidden = false;
    });
    this.canvas.addEventListener("pointerup", (event) => {
      if (!from) return;
      const [start, end] = [from, place(event)];
      from = null;
      if (this.drawing) {
        this.drawing = false;
        this.orbit.enabled = true;
        band.hidden = true;
        this.stage.classList.remove("drawing");
        this.tell.drawn(this._within(start, end));
      } else if (Math.hypot(end[0] - start[0], end[1] - start[1]) < 4 && !this.gizmo.dragging) {
        if (this.aiming) this.tell.aimed(this._pointAt(end));
        else this.tell.picked(this._handAt(end));
      }
    });
  }

  /** The intersections under the mouse, nearest first. */
  _under([x, y], objects) {
    const { clientWidth: width, clientHeight: height } = this.stage;
    const spread = 2 * Math.tan((this.camera.fov * Math.PI) / 360) / height; // of a pixel
    const threshold = NEAR * spread * this.camera.position.distanceTo(this.orbit.target);
    const ray = new THREE.Raycaster();
    ray.params = { Line: { threshold }, Points: { threshold: threshold / 2 } };
    ray.setFromCamera(new THREE.Vector2((2 * x) / width - 1, 1 - (2 * y) / height), this.camera);
    return ray.intersectObjects(objects, false);
  }

  /** The row of the hand at the mouse. */
  _handAt(place) {
    const [first] = this._under(place, (this.hands ?? []).filter(({ visible }) => visible));
    return first ? this.hands.indexOf(first.object) : null;
  }

  /** The visible point of the cloud at the mouse, in the cloud frame. */
  _pointAt(place) {
    const [first] = this._under(place, this.groups.cloud.children);
    return first ? [...this.places.subarray(3 * first.index, 3 * first.index + 3)] : null;
  }

  /** The nearest points in a rectangle in pixels, without those of the plane. */
  _within(start, end) {
    const box = new THREE.Box2().setFromPoints([new THREE.Vector2(...start), new THREE.Vector2(...end)]);
    const [grid] = this.groups.plane.children;
    const normal = grid && new THREE.Vector3(0, 1, 0).applyQuaternion(grid.quaternion);
    const eye = this.root.worldToLocal(this.camera.position.clone());
    const [found, place] = [[], new THREE.Vector3()];
    for (let at = 0; at < this.places.length; at += 3) {
      place.fromArray(this.places, at);
      const pixel = this._pixel(place);
      if (pixel.z > 1 || !box.containsPoint(pixel)) continue;
      if (grid && place.clone().sub(grid.position).dot(normal) < 0.006) continue;
      found.push({ distance: place.distanceTo(eye), point: place.toArray() });
    }
    found.sort((a, b) => a.distance - b.distance);
    const nearest = found[Math.floor(found.length / 50)]?.distance ?? 0; // skips stray points
    return found.filter(({ distance }) => distance < nearest + 0.25).map(({ point }) => point);
  }
}

/** A shade for each z of a cloud without colours, so that its shape is visible. */
function greyOf(points) {
  const z = points.filter((value, i) => i % 3 === 2 && Number.isFinite(value)).sort();
  const [low, high] = [z[Math.floor(0.02 * z.length)], z[Math.floor(0.98 * z.length)]];
  return (value) => {
    const shade = 0.25 + 0.65 * Math.min(Math.max((high - value) / (high - low || 1), 0), 1);
    return [0.85 * shade, 0.92 * shade, shade];
  };
}

function boxShape({ center, half_extents, quaternion }, color) {
  const look = { color, transparent: true, opacity: 0.16, depthWrite: false };
  const box = new THREE.Mesh(BOX, new THREE.MeshBasicMaterial(look));
  box.add(new THREE.LineSegments(EDGES, new THREE.LineBasicMaterial({ color })));
  box.position.set(...center);
  box.quaternion.set(...quaternion);
  box.scale.set(...half_extents).multiplyScalar(2);
  return box;
}

/** The approach point and the contact point of a grasp. */
function ends({ approach_point, contact_point }) {
  return [[approach_point, "#4cc9f0"], [contact_point, "#ff9f1c"]].map(([place, color]) => {
    const look = new THREE.MeshBasicMaterial({ color });
    const made = new THREE.Mesh(new THREE.SphereGeometry(0.004, 12, 8), look);
    made.position.set(...place);
    return made;
  });
}
