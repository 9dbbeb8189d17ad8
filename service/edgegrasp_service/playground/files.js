// Reads the files that the API accepts - .npy, .npz, .ply, .pcd, .xyz, depth images - to show them.
// The server receives the files themselves.

import { PCDLoader } from "./vendor/PCDLoader.js";
import { PLYLoader } from "./vendor/PLYLoader.js";

const CLOUD_ARRAYS = ["points", "normals", "colors", "segment_ids", "view_ids"]; // of an .npz file
const FORMATS = ["npy", "npz", "ply", "pcd", "xyz"];

/** A scene that can be shown and sent: `points` (N, 3), metres, NaN where there is no reading; `colors` (N, 3) from
 * 0 to 1, or null; `camera`, which is at the origin, or null; the data to send, a file `cloud` or an `image` with
 * depth, intrinsics and depth_scale; and a `note` on where that file comes from, if it is not one of the user's files.
 * @typedef {Object} Scene
 */
/** The Scene of one cloud, or of a depth image with or without its colours, whose camera is given as text. */
export async function readScene(files, camera) {
  const images = files.filter((file) => ["png", "npy"].includes(ending(file)));
  if (images.length > 1 || images.some((file) => ending(file) === "png")) return readImages(images, camera);
  if (files.length > 1) throw new Error("Open one cloud, or one depth image and its colours.");
  const file = files[0];
  const format = ending(file);
  if (!FORMATS.includes(format)) {
    throw new Error(`${file.name}: take ${FORMATS.join(", ")}, or a depth image as .png.`);
  }
  const scene = { name: file.name, colors: null, camera: null, cloud: file, image: null, note: "" };
  const bytes = await file.arrayBuffer();
  if (format === "npz") return { ...scene, ...(await readArchive(file, bytes, camera)) };
  if (format === "npy") {
    const array = readArray(bytes);
    if (array.shape.length !== 2 || array.shape[1] === 3) return { ...scene, points: points(array) };
    return { ...scene, ...fromDepth(array, file, null, camera) };
  }
  if (format === "xyz") return { ...scene, points: readText(await file.text()) };
  const loader = format === "ply" ? new PLYLoader() : new PCDLoader();
  const parsed = loader.parse(bytes);
  const { position, color } = (parsed.geometry ?? parsed).attributes;
  return { ...scene, points: position.array, colors: color ? fromLinear(color.array) : null };
}

/** The numbers in a text, separated by commas; NaN for a part that is not a number. */
export function listed(text) {
  return text.replace(/[[\]]/g, "").split(",").map((part) => (part.trim() ? Number(part) : NaN));
}

function ending(file) {
  return file.name.split(".").pop().toLowerCase();
}

/** The flat points of an array (N, 3) or (H, W, 3). */
function points(array) {
  if (array.shape.at(-1) !== 3) throw new Error(`a cloud is (N, 3), this is (${array.shape}); a depth image needs its intrinsics too`);
  return Float32Array.from(array.values);
}

function readText(text) {
  const rows = text.split("\n").map((line) => line.trim().split(/[\s,]+/).slice(0, 3).map(Number));
  return Float32Array.from(rows.filter((row) => row.length === 3).flat());
}

/** Undo three.js's conversion to linear colours: the page shows the colours of the file. */
function fromLinear(values) {
  return values.map((v) => (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055));
}

// Depth images

async function readImages(images, camera) {
  let [depth, color] = [null, null];
  for (const file of images) {
    const bytes = await file.arrayBuffer();
    const head = new Uint8Array(bytes);
    if (ending(file) === "png" ? head[24] === 16 && head[25] === 0 : readArray(bytes).shape[2] !== 3) depth = file;
    else color = file;
  }
  if (images.length > (depth && color ? 2 : 1)) throw new Error("Open one depth image and its colours.");
  if (!depth) throw new Error(`${color.name}: add the depth image, a .png of 16 bits or an .npy.`);
  const read = ending(depth) === "png" ? readDepthPng : async (bytes) => readArray(bytes);
  const array = await read(await depth.arrayBuffer());
  const pixels = color && (await readColors(color));
  if (pixels && (pixels.width !== array.shape[1] || pixels.height !== array.shape[0])) {
    throw new Error(`${color.name} and ${depth.name} differ in size.`);
  }
  return { name: depth.name, ...fromDepth(array, depth, pixels?.colors ?? null, camera) };
}

/** The fields of a Scene made from a depth image (H, W). */
function fromDepth(array, file, colors, { intrinsics, depth_scale }) {
  const given = listed(intrinsics);
  const [fx, fy, cx, cy] = given.length === 9 ? [0, 4, 2, 5].map((place) => given[place]) : given; // of a matrix
  if (![4, 9].includes(given.length) || !given.every(Number.isFinite) || !fx || !fy) {
    throw new NeedsCamera(`${file.name}: give the camera's fx, fy, cx, cy in pixels.`);
  }
  const [height, width] = array.shape;
  const scale = Number(depth_scale) || (array.whole ? 0.001 : 1);
  const found = new Float32Array(3 * width * height);
  for (let pixel = 0; pixel < width * height; pixel++) {
    const z = array.values[pixel] ? scale * Number(array.values[pixel]) : NaN;
    found[3 * pixel] = (((pixel % width) - cx) / fx) * z;
    found[3 * pixel + 1] = ((Math.floor(pixel / width) - cy) / fy) * z;
    found[3 * pixel + 2] = z;
  }
  const camera = { fx, fy, cx, cy, width, height };
  const image = { depth: file, intrinsics: [fx, fy, cx, cy].join(), depth_scale };
  return { points: found, colors, camera, cloud: null, image, note: "" };
}

/** The camera's intrinsics are missing or wrong. */
export class NeedsCamera extends Error {}

async function readColors(file) {
  if (ending(file) === "npy") {
    const { shape: [height, width], values, whole } = readArray(await file.arrayBuffer());
    return { width, height, colors: Float32Array.from(values, (value) => value / (whole ? 255 : 1)) };
  }
  const image = await createImageBitmap(file);
  const { width, height } = image;
  const canvas = new OffscreenCanvas(width, height).getContext("2d");
  canvas.drawImage(image, 0, 0);
  const rgba = canvas.getImageData(0, 0, width, height).data;
  const colors = new Float32Array(3 * width * height);
  for (let i = 0; i < colors.length; i++) colors[i] = rgba[4 * Math.floor(i / 3) + (i % 3)] / 255;
  return { width, height, colors };
}

/** Decode a 16-bit greyscale PNG, which browsers would reduce to 8 bits. */
async function readDepthPng(buffer) {
  const view = new DataView(buffer);
  const [width, height] = [view.getUint32(16), view.getUint32(20)];
  if (view.getUint8(28)) throw new Error("the depth image is interlaced");
  const parts = [];
  for (let at = 8; at < buffer.byteLength; ) {
    const size = view.getUint32(at);
    if (view.getUint32(at + 4) === 0x49444154) parts.push(new Uint8Array(buffer, at + 8, size));
    at += size + 12;
  }
  const row = 2 * width;
  const bytes = await unpack(new Blob(parts), "deflate");
  const values = new Uint16Array(width * height);
  let above = new Uint8Array(row);
  for (let y = 0; y < height; y++) {
    const filter = bytes[y * (row + 1)];
    const line = bytes.subarray(y * (row + 1) + 1, (y + 1) * (row + 1));
    for (let x = 0; x < row; x++) {
      const [left, up, corner] = [x > 1 ? line[x - 2] : 0, above[x], x > 1 ? above[x - 2] : 0];
      line[x] += [0, left, up, (left + up) >> 1, paeth(left, up, corner)][filter];
    }
    for (let x = 0; x < width; x++) values[y * width + x] = (line[2 * x] << 8) | line[2 * x + 1];
    above = line;
  }
  return { shape: [height, width], values, whole: true };
}

function paeth(left, up, corner) {
  const [a, b, c] = [up - corner, left - corner, up + left - 2 * corner].map(Math.abs);
  return a <= b && a <= c ? left : b <= c ? up : corner;
}

// numpy's files

const KINDS = { f4: Float32Array, f8: Float64Array, u1: Uint8Array, u2: Uint16Array, b1: Uint8Array,
  u4: Uint32Array, i1: Int8Array, i2: Int16Array, i4: Int32Array, i8: BigInt64Array };

/** An .npy file: its shape, its values, and whether they are whole numbers. */
function readArray(buffer) {
  const view = new DataView(buffer);
  const start = view.getUint8(6) === 1 ? 10 : 12;
  const size = start === 10 ? view.getUint16(8, true) : view.getUint32(8, true);
  const head = new TextDecoder("latin1").decode(new Uint8Array(buffer, start, size));
  const [, order, kind] = head.match(/'descr': '([<>|=])(\w+)'/) ?? [];
  if (!KINDS[kind] || order === ">" || head.includes("'fortran_order': True")) {
    throw new Error("an .npy file of this kind cannot be shown; save float32, row by row");
  }
  const shape = head.match(/'shape': \(([^)]*)\)/)[1].split(",").filter((s) => s.trim()).map(Number);
  const values = new KINDS[kind](buffer.slice(start + size));
  return { shape, values, whole: !kind.startsWith("f") };
}

/** An .npz file: a cloud, or a depth image with `intrinsics`; `rgb` or `colors` beside either. */
async function readArchive(file, buffer, { depth_scale }) {
  const members = await unzip(buffer);
  const arrays = Object.fromEntries(
    Object.entries(members).map(([name, bytes]) => [name, readArray(bytes)]),
  );
  const shades = arrays.rgb ?? arrays.colors;
  const unit = shades?.whole ? 255 : 1;
  const colors = shades ? Float32Array.from(shades.values, (value) => value / unit) : null;
  const alone = (name) => new File([members[name]], `${name}.npy`);
  const note = (name) => `${name}.npy is the array ${name} of ${file.name}`;
  if (arrays.depth && arrays.intrinsics) {
    const intrinsics = Array.from(arrays.intrinsics.values, (value) => +value.toPrecision(9)).join();
    const camera = { intrinsics, depth_scale };
    return { ...fromDepth(arrays.depth, alone("depth"), colors, camera), note: note("depth") };
  }
  const names = Object.keys(arrays);
  const name = arrays.points ? "points" : names.length === 1 ? names[0] : null;
  if (!name) throw new Error(`${file.name}: holds ${names.join(", ")}, and no points`);
  const found = { points: points(arrays[name]), colors };
  if (name !== "points" || names.every((each) => CLOUD_ARRAYS.includes(each))) return found;
  return { ...found, cloud: alone(name), note: note(name) }; // the API takes no other arrays
}

/** The members of a zip file by name, without .npy. */
async function unzip(buffer) {
  const view = new DataView(buffer);
  let end = buffer.byteLength - 22;
  while (end >= 0 && view.getUint32(end, true) !== 0x06054b50) end--;
  if (end < 0) throw new RangeError("no .npz file");
  const members = {};
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left--) {
    const [name, extra, comment] = [28, 30, 32].map((offset) => view.getUint16(at + offset, true));
    const local = view.getUint32(at + 42, true);
    const start = local + 30 + view.getUint16(local + 26, true) + view.getUint16(local + 28, true);
    const data = buffer.slice(start, start + view.getUint32(at + 20, true));
    const stored = view.getUint16(at + 10, true) === 0;
    const title = new TextDecoder().decode(new Uint8Array(buffer, at + 46, name));
    const bytes = stored ? data : (await unpack(new Blob([data]), "deflate-raw")).buffer;
    members[title.replace(/\.npy$/, "")] = bytes;
    at += 46 + name + extra + comment;
  }
  return members;
}

async function unpack(blob, format) {
  const stream = blob.stream().pipeThrough(new DecompressionStream(format));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
