// The page: builds requests to the public API, and shows the answers.

import { beside } from "./arm.js";
import { NeedsCamera, listed, readScene } from "./files.js";
import { View, colorOf, partsOf } from "./view.js";

const API = new URL("..", import.meta.url).href.replace(/\/$/, ""); // the server's own address
const MOST_REJECTED = 300; // shown; more would hide the cloud
const REASONS = {
  direction: "direction not allowed", support: "below the support", "not-checked": "left out, not checked",
  collision: "collides", "not-scored": "left out, not scored", "low-score": "scores too low",
  suppressed: "near a better one", "beyond-top-k": "beyond top_k",
};
const BOX = ["center", "half_extents"];
const FIELDS = { region: BOX, workspace: BOX, cone: ["direction"] }; // of each shape; three numbers each
const $ = (id) => document.getElementById(id);
const state = {
  files: [], scene: null, answer: null, fresh: true, // answer: grasps by score; fresh: the scene has no answer yet
  robots: [], shapes: {}, target: {}, objects: [], // target: options of the request; objects: possible targets
  grippers: {}, gripper: null, chosen: null, busy: null, followed: null, // followed: `previous` of the next request
};
const view = picture();

start();

function picture() {
  try {
    return new View($("stage"), { picked: choose, edited: readShape, drawn: takeDrawn, aimed: takePoint, object: (number) => aim({ objects: { include: [number] } }) });
  } catch (error) {
    say("The picture needs WebGL, which this browser lacks or has switched off.", true);
    throw error;
  }
}

async function start() {
  state.grippers = await (await fetch("grippers.json")).json();
  $("gripper").replaceChildren(new Option("default", ""), ...Object.keys(state.grippers).map((name) => new Option(name)));
  await listSamples();
  if (await listModels()) await openSample();
}

// Scenes

async function listSamples() {
  const answer = await fetch("samples/samples.json");
  state.samples = answer.ok ? await answer.json() : [];
  for (const [row, { name }] of state.samples.entries()) $("sample").add(new Option(name, row));
  $("sample").closest("label").hidden = !state.samples.length;
}

/** Show the chosen sample, and ask for its grasps. */
async function openSample() {
  const sample = state.samples[$("sample").value];
  if (!sample) return say("Open a point cloud or a depth image.");
  for (const field of ["intrinsics", "depth_scale", "viewpoint"]) $(field).value = sample[field] ?? "";
  const files = await Promise.all(sample.files.map(async (name) => {
    const answer = await reach(`samples/${encodeURIComponent(name)}`);
    if (!answer.ok) throw new Error(`${name}: the server answers ${answer.status}.`);
    return new File([await answer.blob()], name);
  })).catch((error) => say(error.message, true));
  if (files && (await open(files))) await ask();
}

/** Read files and show them; returns whether that succeeded. */
async function open(files) {
  state.busy?.abort(); // its answer would belong to another scene
  state.files = files;
  [state.answer, state.scene, state.fresh, state.target] = [null, null, true, {}];
  if (!$("follow").checked) $("base").value = ""; // a followed scene keeps its frame
  const image = files.some(({ name }) => /\.png$/i.test(name));
  $("camera").hidden = !image;
  try {
    busy(`Reading ${files.map(({ name }) => name).join(", ")}…`);
    const scene = await readScene(files, { intrinsics: $("intrinsics").value, depth_scale: $("depth_scale").value });
    scene.viewpoint = numbers($("viewpoint").value, 3);
    view.showScene(scene);
    state.scene = scene;
    if (scene.image) Object.entries(scene.image).forEach(([name, value]) => name === "depth" || ($(name).value = value));
  } catch (error) {
    if (error instanceof NeedsCamera) $("camera").hidden = false;
    view.clear();
    $("curl").textContent = $("python").textContent = "";
    const damaged = error instanceof TypeError || error instanceof RangeError; // of a reader that ran out of bytes
    say(damaged ? `${files[0].name}: the file is damaged, or of another format than its name says.` : error.message, true);
    return false;
  } finally {
    busy(null);
    showAnswer();
  }
  $("camera").hidden = !state.scene.image;
  $("viewpoint_row").hidden = Boolean(state.scene.image);
  for (const name of Object.keys(state.shapes)) setShape(name, null);
  say(`${(state.scene.points.length / 3).toLocaleString("en")} points of ${state.scene.name}.`);
  return true;
}

// The request

/** The options that differ from the API's defaults. */
function options() {
  const found = {};
  const viewpoint = state.scene?.image ? null : typed("viewpoint", 3);
  if (viewpoint) found.viewpoint = viewpoint;
  for (const name of ["model", "gripper"]) if ($(name).value) found[name] = $(name).value;
  const { cone, region, workspace } = state.shapes;
  if (cone) found.approach_direction = { cones: [rounded(cone)] };
  else if ($("approach").value) found.approach_direction = { preset: $("approach").value };
  if (region) {
    const asked = { [$("region_kind").value]: [{ kind: "oriented_box", ...rounded(region) }] };
    Object.assign(found, { approach_region: asked, contact_region: asked });
  }
  if (workspace) {
    const corner = (sign) => workspace.center.map((value, axis) => value + sign * workspace.half_extents[axis]);
    found.workspace = rounded({ min: corner(-1), max: corner(1) });
  }
  Object.assign(found, state.target);
  const base = robot() && typed("base", 16);
  if (base) found.robot = { name: robot().name, T_base_cloud: base, joints: typed("joints", robot().home.length) ?? robot().home };
  if ($("debug").checked) found.debug = true;
  if ($("follow").checked) found.previous = state.followed ?? {};
  const more = $("more").value.trim();
  if (more && !/^{/.test(more)) throw new Error("More options: give a JSON object.");
  return more ? { ...found, ...JSON.parse(more) } : found;
}

/** The option `previous` of the next request: a grasp of this answer, and its objects. */
function previous(grasp) {
  const { tracking, objects } = state.answer;
  return {
    gripper: state.answer.gripper.name, next_id: tracking.next_id,
    grasps: [{ id: grasp.id, T_cloud_hand: grasp.T_cloud_hand.flat(), object: grasp.object }],
    objects: objects.filter(({ surface }) => surface).map(({ number, surface, confidence }) => ({ number, surface, confidence })),
  };
}

/** The arm that is chosen. */
function robot() {
  return state.robots.find(({ name }) => name === $("robot").value);
}

function joints() {
  return numbers($("joints").value, robot().home.length) ?? robot().home;
}

function rounded(shape, digits = 5) {
  return JSON.parse(JSON.stringify(shape, (_, value) => (typeof value === "number" ? +value.toFixed(digits) : value)));
}

/** The parts of the form that is sent. */
function parts(asked) {
  const { cloud, image } = state.scene;
  const all = { ...(cloud ? { cloud } : image), options: Object.keys(asked).length ? JSON.stringify(asked) : "" };
  return Object.entries(all).filter(([, value]) => value);
}

/** Ask for grasps, and show them; the newest request wins. */
async function ask() {
  if (!state.scene && !(state.files.length && (await open(state.files)))) return;
  if (robot() && !$("base").value && state.answer?.objects.length) $("base").value = rounded(beside(state.answer, view.eye ?? [0, 0, 0]), 6);
  let asked;
  try {
    asked = options();
  } catch (error) {
    return say(error instanceof SyntaxError ? "More options: invalid JSON." : error.message, true);
  }
  state.busy?.abort();
  const stop = (state.busy = new AbortController());
  busy("Looking for grasps…");
  try {
    showCode(asked);
    const start = performance.now();
    const body = new FormData();
    for (const [name, value] of parts(asked)) body.append(name, value);
    const answer = await call("/v1/grasps", { method: "POST", signal: stop.signal, body });
    if (!asked.robot && !asked.previous && !asked.order) answer.grasps.sort((one, other) => other.score - one.score);
    [state.answer, state.gripper] = [answer, gripperOf(asked, answer.model)];
    view.showAnswer(answer, state.gripper, state.fresh);
    state.fresh = false;
    view.showArm(asked.robot && robot(), asked.robot?.T_base_cloud);
    showAnswer();
    say(`${((performance.now() - start) / 1000).toFixed(2)} s, of which ${answer.seconds.total.toFixed(2)} s detecting, by ${answer.model}.`);
    if (robot() && !asked.robot && answer.objects.length) return ask();
  } catch (error) {
    if (error.name !== "AbortError") say(error.message, true);
  } finally {
    if (state.busy === stop) busy((state.busy = null));
  }
}

function gripperOf(asked, model) {
  if (asked.gripper && typeof asked.gripper === "object") {
    const { hand, contact_z } = asked.gripper;
    const palm_z = Math.max(...hand.boxes.map(([, high]) => high[2]).filter((z) => z < contact_z));
    return { ...asked.gripper, palm_z };
  }
  const own = state.models.find(({ name }) => name === model)?.gripper;
  return state.grippers[asked.robot ? robot().gripper : asked.gripper || own] ?? state.grippers.panda;
}

/** The API's answer; an error is thrown with the API's message. */
async function call(path, { headers = {}, ...rest } = {}) {
  const token = $("token").value.trim();
  if (token) headers = { ...headers, authorization: `Bearer ${token}` };
  const answer = await reach(API + path, { headers, ...rest });
  if (answer.status === 401) {
    $("token_row").hidden = false;
    $("token").focus();
    throw new Error(token ? "The server does not know this token." : "This server needs a token.");
  }
  const body = await answer.json().catch(() => ({})); // a proxy's error is no JSON
  if (!answer.ok) throw Object.assign(new Error(body.detail ?? `${answer.status}`), { kind: body.type });
  return body;
}

function reach(...request) {
  return fetch(...request).catch((error) => {
    throw error instanceof TypeError ? new Error("The server cannot be reached.") : error;
  });
}

/** Fill the lists of models and robots; returns whether the server answers. */
async function listModels() {
  try {
    state.models = (await call("/v1/models")).models;
    state.robots = (await call("/v1/robots")).robots;
  } catch (error) {
    say(error.message, true);
    if (error.kind !== "urn:edgegrasp:error:not-ready") return false;
    await new Promise((done) => setTimeout(done, 1000));
    return listModels();
  }
  $("model").replaceChildren(...state.models.map(({ name, default: first }) => new Option(name, first ? "" : name)));
  $("model").value = "";
  $("robot").replaceChildren(new Option("none", ""), ...state.robots.map(({ name }) => new Option(name)));
  $("robot_row").hidden = !state.robots.length;
  return true;
}

// The answer

function showAnswer() {
  const { answer } = state;
  const grasps = answer?.grasps ?? [];
  state.chosen = null;
  $("summary").textContent = answer
    ? `${grasps.length} grasp${grasps.length === 1 ? "" : "s"} on ${answer.objects.filter((o) => o.best_score !== null).length} of ${answer.objects.length} objects`
    : "No grasps yet";
  const failed = (answer?.objects ?? []).filter(({ reason }) => reason);
  const told = failed.map(({ number, reason }) => `Object ${number} has no good grasp: ${reason.replace("-", " ")}.`);
  $("warnings").replaceChildren(...[...(answer?.warnings ?? []), ...told].map((text) => element("li", text)));
  if (answer) $("count").max = Math.max(grasps.length, 12);
  $("grasps").replaceChildren(...grasps.map(line));
  const counts = Object.entries(answer?.counts ?? {});
  $("counts").replaceChildren(...counts.map(([name, count]) => {
    const row = element("tr", "");
    row.append(element("td", name.replaceAll("_", " ")), element("td", count.toLocaleString("en")));
    return row;
  }));
  if (!Object.keys(state.target).length) state.objects = answer?.objects ?? [];
  showReasons();
  showTargets();
  filter();
}

function line(grasp, row) {
  const button = element("button", "");
  button.type = "button";
  const meter = Object.assign(element("meter", ""), { min: 0, max: 1, value: grasp.score });
  meter.style.setProperty("--tint", `#${colorOf(grasp.score).getHexString()}`);
  const cells = [row + 1, grasp.score.toFixed(3)].map((text) => element("span", text));
  const object = grasp.object === null ? "" : `object ${grasp.object}`;
  button.append(...cells, meter, element("small", grasp.arm?.reachable === false ? `${object}, out of reach` : object));
  button.addEventListener("click", () => choose(row));
  const item = element("li", "");
  item.append(button);
  return item;
}

/** Show the grasps that the sliders select. */
function filter() {
  const [least, most] = [Number($("min_score").value), Number($("count").value)];
  $("min_score_value").textContent = least.toFixed(2);
  $("count_value").textContent = most;
  const grasps = state.answer?.grasps ?? [];
  const rows = grasps.map((_, row) => row).filter((row) => grasps[row].score >= least).slice(0, most);
  [...$("grasps").children].forEach((item, row) => (item.hidden = !rows.includes(row)));
  if (state.answer) view.showHands(rows);
  choose(rows.includes(state.chosen) ? state.chosen : rows[0] ?? null);
}

function choose(row) {
  state.chosen = row;
  const grasp = state.answer?.grasps[row] ?? null;
  if (state.answer) view.choose(grasp);
  if (robot()) view.bendArm(grasp?.arm?.grasp_joints ?? joints());
  [...$("grasps").children].forEach((item, each) => item.firstChild.setAttribute("aria-pressed", each === row));
  $("chosen").hidden = !grasp;
  if (!grasp) return;
  if (state.answer.tracking) state.followed = previous(grasp);
  const [list, { offsetTop, offsetHeight }] = [$("grasps"), $("grasps").children[row]];
  list.scrollTop = Math.min(Math.max(list.scrollTop, offsetTop + offsetHeight - list.clientHeight), offsetTop);
  $("rank").textContent = row + 1;
  const metres = (values) => `${values.map((value) => value.toFixed(3)).join(", ")} m`;
  const facts = {
    score: grasp.score.toFixed(3),
    TCP: metres(grasp.T_cloud_tcp.slice(0, 3).map((each) => each[3])),
    approach: grasp.approach_direction.map((value) => value.toFixed(2)).join(", "),
    width: `${(1000 * grasp.width).toFixed(1)} mm${grasp.far_side_hidden ? ", far side hidden" : ""}`,
    "approach point": metres(grasp.approach_point),
    "contact point": metres(grasp.contact_point),
    clearance: `${(1000 * grasp.clearance).toFixed(1)} mm${grasp.collision_free ? "" : ", collides"}`,
    object: grasp.object ?? "none",
    ...(grasp.arm && { arm: grasp.arm.reachable ? "within reach" : "out of reach" }),
    ...(grasp.arm?.trajectory && { motion: `${grasp.arm.trajectory.times.at(-1).toFixed(1)} s` }),
  };
  $("play").hidden = !grasp.arm?.trajectory;
  $("numbers").replaceChildren(...Object.entries(facts).flatMap(([name, text]) => [element("dt", name), element("dd", text)]));
  $("chosen_json").textContent = JSON.stringify(grasp, null, 1);
}

function showReasons() {
  const debug = state.answer?.debug;
  $("keep").hidden = !state.answer || Boolean(debug);
  const found = {};
  debug?.outcome.forEach((outcome, row) => outcome === "returned" || (found[outcome] ??= []).push(debug.T_cloud_hand[row]));
  $("reasons").replaceChildren(...Object.entries(found).map(([outcome, poses]) => {
    const button = element("button", `${REASONS[outcome] ?? outcome}: ${poses.length.toLocaleString("en")}`);
    Object.assign(button, { type: "button" }).setAttribute("aria-pressed", "false");
    button.addEventListener("click", () => {
      const on = button.getAttribute("aria-pressed") === "false";
      for (const each of $("reasons").children) each.setAttribute("aria-pressed", String(on && each === button));
      const step = Math.ceil(poses.length / MOST_REJECTED);
      view.showRejected(on ? poses.filter((_, row) => row % step === 0) : []);
      if (on && step > 1) say(`One of every ${step} is shown.`);
    });
    return button;
  }));
}

/** Show the same request as a curl command and as a Python program. */
function showCode(asked) {
  const { cloud, image, note } = state.scene;
  const token = $("token").value.trim();
  const file = (cloud ?? image.depth).name;
  const quoted = (text) => (/^[\w=,.@:/-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
  const part = (value) => (value instanceof File ? `@${/[,;"\\]/.test(value.name) ? JSON.stringify(value.name) : value.name}` : value);
  const sent = parts(asked).map(([name, value]) => `-F ${quoted(`${name}=${part(value)}`)}`);
  if (token) sent.unshift('-H "Authorization: Bearer $EDGEGRASP_CLIENT_TOKEN"');
  $("curl").textContent = (note ? `# ${note}\n` : "") + [`curl -sS ${API}/v1/grasps`, ...sent].join(" \\\n  ");
  const { intrinsics, depth_scale: scale } = image ?? {};
  const camera = { intrinsics: JSON.parse(`[${intrinsics ?? ""}]`), ...(scale && { depth_scale: Number(scale) }) };
  const what = cloud ? inPython(file) : `depth_images=[${inPython({ depth: file, ...camera })}]`;
  const given = Object.entries(asked).map(([name, value]) => `,\n        ${name}=${inPython(value)}`).join("");
  $("python").textContent = `${note ? `# ${note}\n` : ""}${token ? "import os\n\n" : ""}from edgegrasp_client import GraspClient

with GraspClient("${API}"${token ? ', token=os.environ["EDGEGRASP_CLIENT_TOKEN"]' : ""}) as client:
    detection = client.detect(
        ${what}${given},
    )
for grasp in detection.grasps:
    print(grasp.score, grasp.T_cloud_hand)`;
}

function inPython(value) {
  if (value === null) return "None";
  if (typeof value === "boolean") return value ? "True" : "False";
  if (Array.isArray(value)) return `[${value.map(inPython).join(", ")}]`;
  if (typeof value !== "object") return JSON.stringify(value);
  return `{${Object.entries(value).map(([name, each]) => `"${name}": ${inPython(each)}`).join(", ")}}`;
}

/** Save the picture, the answer, or its grasps as an `isaac_grasp` file. */
async function save(kind) {
  if (!state.answer) return say("There are no grasps yet.", true);
  const text = { json: () => JSON.stringify(state.answer, null, 1), isaac: isaacGrasps }[kind]?.();
  const blob = text ? new Blob([text]) : await view.picture();
  const name = { json: "grasps.json", isaac: "grasps.yaml", picture: "grasps.png" }[kind];
  const href = URL.createObjectURL(blob);
  Object.assign(document.createElement("a"), { href, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(href), 10_000);
}

/** An `isaac_grasp` file, in the frame of the cloud; JSON is YAML too. */
function isaacGrasps() {
  const joints = (opening) => {
    const panda = state.gripper === state.grippers.panda;
    return panda ? { panda_finger_joint1: opening / 2, panda_finger_joint2: opening / 2 } : {};
  };
  const grasps = state.answer.grasps.map((grasp, row) => {
    const { position, quaternion: [x, y, z, w] } = partsOf(grasp.T_cloud_hand);
    const postures = { cspace_position: joints(0), pregrasp_cspace_position: joints(grasp.width) };
    return [`grasp_${row}`, { confidence: grasp.score, position, orientation: { w, xyz: [x, y, z] }, ...postures }];
  });
  const file = { format: "isaac_grasp", format_version: 1.0, object_frame_link: "cloud", gripper_frame_link: "hand",
    grasps: Object.fromEntries(grasps) };
  return JSON.stringify(rounded(file, 6), null, 1).replace('"format_version": 1,', '"format_version": 1.0,');
}

// The target: one object, or the object at a point

function showTargets() {
  const asked = state.target.objects?.include[0];
  $("all").setAttribute("aria-pressed", String(!Object.keys(state.target).length));
  const all = state.objects.map(({ number }) => number).sort((one, other) => one - other);
  $("objects").replaceChildren(...all.map((number) => {
    const button = Object.assign(element("button", number), { type: "button", title: `object ${number} only` });
    button.setAttribute("aria-pressed", String(number === asked));
    button.addEventListener("click", () => aim({ objects: { include: [number] } }));
    return button;
  }));
}

/** Ask for the grasps of a target, which is a set of options; empty: all objects. */
function aim(target) {
  state.target = target;
  return ask();
}

/** Ask for the grasps of the object at a point, in the cloud frame. */
function takePoint(point) {
  press(null);
  if (!point) return say("There is no point here; click on one of the cloud.", true);
  const [x, y, z] = point;
  const { camera, image } = state.scene;
  if (image) return aim({ at: [Math.round((camera.fx * x) / z + camera.cx), Math.round((camera.fy * y) / z + camera.cy)] });
  return aim({ near: rounded(point) });
}

// Shapes: region and workspace are boxes; the cone contains approach directions

function setShape(name, shape) {
  if (shape) state.shapes[name] = shape;
  else delete state.shapes[name];
  view.setShape(name, shape);
  $(`${name}_row`).hidden = !shape;
  if (name === "cone" && !shape && $("approach").value === "cone") $("approach").value = "";
  press(null);
  writeShape(name);
}

/** Copy a shape that was edited with the mouse into its fields. */
function readShape(name) {
  Object.assign(state.shapes[name], view.shape(name));
  writeShape(name);
}

function writeShape(name) {
  const shape = state.shapes[name];
  if (!shape) return;
  for (const field of FIELDS[name]) $(`${name}_${field}`).value = shape[field].map((value) => +value.toFixed(4)).join(",");
}

/** Set a shape from its fields. */
function typeShape(name) {
  const shape = { ...state.shapes[name] };
  for (const field of FIELDS[name]) {
    const values = numbers($(`${name}_${field}`).value, 3);
    if (!values) return say("Three numbers are needed: x, y, z.", true);
    shape[field] = values;
  }
  if (name === "cone") shape.max_angle = coneAngle();
  setShape(name, shape);
}

function coneAngle() {
  return (Number($("cone_angle").value) * Math.PI) / 180;
}

function takeDrawn(points) {
  const name = state.drawing;
  press(null);
  if (!points.length) return say("There are no points inside; draw around some.", true);
  setShape(name, view.boxAround(points, name === "region"));
  say(`A box around ${points.length.toLocaleString("en")} points; move or resize it, then ask again.`);
}

/** Show which of the drawing and editing buttons is active. */
function press(button) {
  for (const each of document.querySelectorAll("[data-draw], [data-edit], #pick")) {
    each.setAttribute("aria-pressed", String(each === button));
  }
  view.startAiming(button === $("pick"));
  if (!button?.dataset.edit) view.edit(null);
}

// Wiring

$("ask").addEventListener("submit", (event) => {
  event.preventDefault();
  ask();
});
$("files").addEventListener("change", ({ target }) => take([...target.files]));
$("sample").addEventListener("change", openSample);
$("token").addEventListener("change", async () => (await listModels()) && (state.scene ? ask() : openSample()));
for (const name of ["intrinsics", "depth_scale", "viewpoint"]) {
  $(name).addEventListener("change", () => state.files.length && open(state.files));
}
for (const name of ["min_score", "count"]) $(name).addEventListener("input", filter);
$("point_size").addEventListener("input", ({ target }) => view.setPointSize(Number(target.value)));
$("all").addEventListener("click", () => aim({}));
$("pick").addEventListener("click", ({ target }) => {
  if (!state.scene) return;
  const on = target.getAttribute("aria-pressed") !== "true";
  press(on ? target : null);
  if (on) say("Click on a point of the object to grasp.");
});
$("play").addEventListener("click", () => view.playArm(state.answer.grasps[state.chosen].arm.trajectory));
$("robot").addEventListener("change", () => {
  $("arm_row").hidden = !robot();
  $("joints").value = robot() ? rounded(robot().home, 4) : "";
  ask();
});
$("follow").addEventListener("change", () => {
  state.followed = null;
  ask();
});
$("keep").addEventListener("click", () => ($("debug").checked = true) && ask());
$("approach").addEventListener("change", ({ target }) => {
  const down = state.answer ? state.answer.up.map((value) => -value) : [0, 0, -1];
  setShape("cone", target.value === "cone" && state.scene ? { direction: down, max_angle: coneAngle() } : null);
});
for (const name of ["region", "workspace", "cone"]) {
  $(`${name}_row`).addEventListener("change", ({ target }) => target.tagName === "INPUT" && typeShape(name));
}
document.addEventListener("click", ({ target, detail }) => {
  const { draw, edit, mode, clear, copy, look, save: kind } = target.dataset ?? {};
  if (draw && state.scene && !detail) { // pressed with the keyboard
    const around = view.boxAround([view.target ?? view.middle], draw === "region");
    setShape(draw, { ...around, half_extents: [0.05, 0.05, 0.05] });
    $(`${draw}_center`).focus();
    say("A box of 10 cm: type its centre and size, then ask again.");
  } else if (draw && state.scene) {
    state.drawing = draw;
    press(target);
    view.startDrawing();
    say("Drag a rectangle around the points to enclose.");
  } else if (edit) {
    const on = target.getAttribute("aria-pressed") !== "true";
    press(on ? target : null);
    if (on) view.edit(edit, mode);
  } else if (clear) setShape(clear, null);
  else if (copy) copyText($(copy).textContent);
  else if (look && state.scene) view.look(look);
  else if (kind) save(kind);
});
document.addEventListener("change", ({ target }) => target.dataset.show && view.show(target.dataset.show, target.checked));
for (const kind of ["dragover", "dragleave", "drop"]) {
  document.addEventListener(kind, (event) => {
    event.preventDefault();
    document.body.classList.toggle("over", kind === "dragover");
    if (kind === "drop" && event.dataTransfer.files.length) take([...event.dataTransfer.files]);
  });
}

/** Open the user's files; the camera's fields are kept only while following, which uses one camera. */
async function take(files) {
  if (!files.length) return;
  if (!$("follow").checked) for (const field of ["intrinsics", "depth_scale", "viewpoint"]) $(field).value = "";
  $("sample").selectedIndex = -1;
  if (await open(files)) await ask();
}

function copyText(text) {
  const copied = navigator.clipboard?.writeText(text) ?? Promise.reject(); // needs TLS, except on localhost
  return copied.then(() => say("Copied."), () => say("The browser does not allow copying.", true));
}

/** The numbers in a field; null if it is empty. */
function typed(id, count) {
  const found = numbers($(id).value, count);
  if (found || !$(id).value.trim()) return found;
  throw new Error(`${$(id).labels[0].textContent.trim()}: ${count} numbers are needed, separated by commas.`);
}

function numbers(text, count) {
  const values = listed(text);
  return values.length === count && values.every(Number.isFinite) ? values : null;
}

function element(tag, text) {
  return Object.assign(document.createElement(tag), { textContent: text });
}

function say(text, bad = false) {
  $("status").textContent = text;
  $("status").classList.toggle("bad", bad);
}

function busy(text) {
  $("status").classList.toggle("busy", Boolean(text));
  if (text) say(text);
}
