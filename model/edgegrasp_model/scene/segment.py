"""Classifies each point with the `scene` network as one of the objects, support or background."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import RLock
from typing import NamedTuple

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import load_file
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.spatial import cKDTree
from torch.nn import functional

from edgegrasp_camera.arrays import Bools, Float32, Float64, Floats, Int64
from edgegrasp_model.kernels import compiled
from edgegrasp_model.scene.cloud import CheckedCloud, grid_cells, subsample, unit
from edgegrasp_model.scene.network import FAST, NEAREST_DEPTH, SceneNet, range_image, scene_features

WEIGHTS = Path(__file__).with_name("network.safetensors")
_ALONE = RLock()  # held while PyTorch uses one thread

# In place of an object's number. An undecided point may be part of an object.
BACKGROUND, UNDECIDED = -1, -2

# Which pixels and points belong to the same object.
MAX_DEPTH_STEP = 0.035  # metres between neighbours, and between the mean votes of two parts
MIN_PIXELS = 45  # pixels of an object, in the network's output
MIN_AREA = 5e-4  # square metres of the visible part of an object
MIN_VIEW_OVERLAP = 0.25  # share of the smaller object's cells (POINT_REACH wide) in both views
POINT_REACH = 0.012  # metres from a point to an object, or to its pixel at a depth of 0
MIN_RISE = 0.004  # metres above the support's margin, of points that are added to an object
MIN_CLUSTER_CELLS, MIN_CELL_POINTS = 5, 4  # cells, POINT_REACH wide; mean points in one
MIN_CONFIDENCE = 0.5  # of an object; below, it is background
BESIDE_FACTOR = 0.65  # on the confidence of small parts beside objects: 33 of 55 were objects
CROPPED_CONFIDENCE = 0.95  # of clusters in a cloud that was cropped above its support


class Segmentation(NamedTuple):
    """The segmentation of N points."""

    object_of_point: Int64  # (N,) each point's object, from 0, or BACKGROUND or UNDECIDED
    object_probability: Float32  # (N,) probability of an object
    support_probability: Float32  # (N,) probability of a support
    confidence: Float64  # (O,) confidence of each object
    up: Float64  # (3,) unit, away from gravity, estimated by the network; cloud frame


class Pixels(NamedTuple):
    """The network's output for each pixel, and the point seen there; camera frame."""

    points: Float32  # (H, W, 3) metres; NaN where nothing was seen
    classes: Float32  # (3, H, W) probabilities
    votes: Float32  # (H, W, 3) metres from each point to the centre of its object
    links: Float32  # (2, H, W) probability of showing the same object as the right, lower pixel
    footprint: float  # metres, width of a pixel at a depth of one metre


@cache
def load_scene_network() -> tuple[SceneNet, Float64]:
    """The `scene` network with the shipped weights, loaded once per process, and its calibration.

    The calibration (2,) gives the log odds that an instance is an object: a constant, plus a factor
    times the mean probability of an object over the instance's pixels.
    """
    with torch.device("meta"):
        network = SceneNet()
    network.load_state_dict(load_file(WEIGHTS), assign=True)
    network.eval().fused().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    with safe_open(WEIGHTS, "pt") as file:
        return network, np.array(json.loads(file.metadata()["confidence"]))


def confidences(mean: Float64) -> Float64:
    """The confidence (O,) of instances, from the mean probability (O,) of an object over each."""
    constant, factor = load_scene_network()[1]
    return np.asarray(1.0 / (1.0 + np.exp(-(constant + factor * mean))))


def segment_cloud(
    cloud: CheckedCloud,  # N points
    viewpoints: Float64,  # (W, 3) of the cameras
    up: Float64 | None,  # (3,) unit, away from gravity; None: unknown
    near: Int64 | slice,  # rows to segment, if there is one camera
) -> Segmentation:
    """Segment a cloud view by view; an object seen in several views gets one number."""
    points = cloud.points
    number, confidence, seen_up = np.full(len(points), UNDECIDED), np.empty(0), np.zeros(3)
    sizes = list[int]()  # how many objects each view shows
    objects, support = np.zeros((2, len(points)), dtype=np.float32)
    down: Float64 | None = None
    rows_of_view: list[Int64 | slice] = [near]
    if len(viewpoints) > 1:
        assert cloud.view_ids is not None
        rows_of_view = [np.flatnonzero(cloud.view_ids == view) for view in range(len(viewpoints))]
    elif cloud.image_size is not None:
        row = subsample(cloud.row, 5000) // cloud.image_size[1]
        sight = unit(subsample(points, 5000) - viewpoints[0])
        down = np.asarray((row - row.mean()) @ sight, dtype=np.float64)
    if not isinstance(near, slice):  # from above, in an image that rotates with the points
        sight = points[near] - viewpoints[0]
        down = sight[np.linalg.norm(sight, axis=1).argmax()]
    seen = [(rows, points[rows], eye) for rows, eye in zip(rows_of_view, viewpoints, strict=True)]
    views = [view for view in seen if len(view[1])]
    for rows, part, viewpoint in views:
        own = segment(part, viewpoint, up, down)
        own_number = own.object_of_point
        number[rows] = np.where(own_number >= 0, own_number + len(confidence), own_number)
        objects[rows], support[rows] = own.object_probability, own.support_probability
        confidence = np.concatenate([confidence, own.confidence])
        sizes.append(len(own.confidence))
        seen_up += own.up * len(own.object_of_point)
    if len(views) > 1:
        view = np.repeat(np.arange(len(views)), sizes)
        number, confidence = merge_views(points, number, confidence, view)
    return Segmentation(number, objects, support, confidence, unit(seen_up))


def segment(
    points: Float32,  # (N, 3) cloud frame, metres
    viewpoint: Float64,  # (3,) of the camera that saw them
    up: Float64 | None,  # (3,) unit, away from gravity; None: unknown
    down: Float64 | None,  # (3,) downward in the image, used if `up` is unknown
) -> Segmentation:
    """Segment points seen by one camera."""
    image, (network, _) = range_image(points, viewpoint, up, down), load_scene_network()
    up_in_view = None if up is None else image.R_camera_cloud @ up
    features = scene_features(image.points, up_in_view, image.footprint)
    pixels, seen_up = run_network(network, features, image.points, image.footprint)
    of_pixel, mean = group_pixels(pixels)
    confidence = confidences(mean)
    likely = confidence > MIN_CONFIDENCE
    new = np.append(np.where(likely, np.cumsum(likely) - 1, BACKGROUND), [UNDECIDED, BACKGROUND])
    eye = image.R_camera_cloud @ viewpoint
    labels = _label_points(points, image.R_camera_cloud, eye, image.corner, pixels, new[of_pixel])
    return Segmentation(*labels, confidence[likely], seen_up @ image.R_camera_cloud)


def run_network(
    network: SceneNet,  # in evaluation mode
    features: Float32,  # (INPUT_CHANNELS, H, W) as of `scene_features`
    points: Float32,  # (H, W, 3) camera frame, metres; NaN where nothing was seen
    footprint: float,  # width of a pixel at a depth of one metre, metres
) -> tuple[Pixels, Float64]:
    """A network's output for a range image, and its estimate of up (3,); camera frame."""
    fast = torch.autocast("cpu", torch.bfloat16, enabled=FAST is torch.bfloat16)
    with torch.inference_mode(), one_thread(), fast:
        output = network(torch.from_numpy(features)[None])
        classes = output.classes[0].softmax(dim=0).contiguous().numpy()
        votes = output.votes[0].permute(1, 2, 0).contiguous().numpy()
        links = output.links[0].sigmoid().contiguous().numpy()
        ways = functional.normalize(output.up[0], dim=0).numpy()
    seen = np.ascontiguousarray(points[::2, ::2])
    seen_up = ways[:, ~np.isnan(seen[..., 2])].sum(axis=1).astype(np.float64)
    if not seen_up.any():  # nothing was seen: assume up is toward the camera
        seen_up = np.array([0.0, 0.0, -1.0])
    return Pixels(seen, classes, votes, links, 2 * footprint), unit(seen_up)


@contextmanager
def one_thread() -> Iterator[None]:
    """A network's output must not depend on the number of threads."""
    with _ALONE:  # else another thread restores our number
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(threads)


def group_pixels(pixels: Pixels) -> tuple[Int64, Float64]:
    """The object (H, W) of each pixel, from 0, or BACKGROUND or UNDECIDED.

    Also returns the mean probability (O,) of an object over the pixels of each object.
    """
    points, classes, votes, links, footprint = pixels
    seen = ~np.isnan(points[..., 2])
    held = seen & (classes.argmax(axis=0) == 2)
    number = np.where(held, UNDECIDED, BACKGROUND)
    index, pairs, strength = np.arange(held.size).reshape(held.shape), [], []
    right, lower = (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1, :], np.s_[1:, :])  # neighbours
    for link, (first, second) in zip(links, (right, lower), strict=True):
        near = np.abs(points[first][..., 2] - points[second][..., 2]) < MAX_DEPTH_STEP
        joined = held[first] & held[second] & (link[first] > 0.5) & near
        pairs.append(np.stack([index[first][joined], index[second][joined]], axis=1))
        strength.append(link[first][joined])
    order = np.argsort(-np.concatenate(strength), kind="stable")
    component = np.arange(held.size)
    centre = np.nan_to_num(points + votes).reshape(-1, 3).astype(np.float64)
    _join_pixels(np.concatenate(pairs)[order], component, centre)
    rows = np.flatnonzero(held)
    _, part, count = np.unique(component[rows], return_inverse=True, return_counts=True)
    area = np.bincount(part, (points[..., 2].reshape(-1)[rows] * footprint) ** 2)
    large = (count >= MIN_PIXELS) & (area >= MIN_AREA)
    number.reshape(-1)[rows] = np.where(large, np.cumsum(large) - 1, UNDECIDED)[part]
    held = number >= 0
    return number, np.bincount(number[held], classes[2][held]) / np.bincount(number[held])


@compiled()
def _join_pixels(
    pairs: Int64,  # (P, 2) the most probable first
    component: Int64,  # (N,) overwritten with the part of each pixel
    centre: Float64,  # (N, 3) metres, the vote of each pixel; overwritten by sums
) -> None:
    """Join pairs of pixels in order, but not two large parts with different centres.

    That way, one weak link cannot join two objects (Kruskal's algorithm with that exception).
    """
    count = np.ones(len(component), dtype=np.int64)
    for p in range(len(pairs)):
        a, b = pairs[p, 0], pairs[p, 1]
        while component[a] != a:
            component[a] = component[component[a]]
            a = component[a]
        while component[b] != b:
            component[b] = component[component[b]]
            b = component[b]
        if a == b:
            continue
        if count[a] >= MIN_PIXELS and count[b] >= MIN_PIXELS:
            away = 0.0
            for d in range(3):
                away += (centre[a, d] / count[a] - centre[b, d] / count[b]) ** 2
            if away > MAX_DEPTH_STEP * MAX_DEPTH_STEP:
                continue
        if count[a] < count[b]:
            a, b = b, a
        component[b] = a
        count[a] += count[b]
        for d in range(3):
            centre[a, d] += centre[b, d]
    for n in range(len(component)):
        root = n
        while component[root] != root:
            root = component[root]
        component[n] = root


def merge_views(
    points: Float32,  # (N, 3) metres, of all views
    number: Int64,  # (N,) of the objects that the views show
    confidence: Float64,  # (O,)
    view: Int64,  # (O,) the view that shows each object
) -> tuple[Int64, Float64]:
    """Join overlapping objects of different views; returns their numbers (N,) and confidences.

    Pairs that overlap most are joined first; two objects of one view stay apart. Points of an
    object that overlaps both belong to what most views show there, on ties to the smaller object.
    """
    held = np.flatnonzero(number >= 0)
    if len(held) == 0:
        return number, confidence
    cell, points_in = grid_cells(points[held], POINT_REACH)
    shape = len(confidence), len(points_in)
    lies = coo_array((np.ones(len(held), dtype=np.int32), (number[held], cell)), shape).tocsr()
    lies.data[:] = 1
    shared = (lies @ lies.T).toarray()
    cells = np.maximum(np.diag(shared), 1)
    pairs = np.argwhere(np.triu(shared >= MIN_VIEW_OVERLAP * np.minimum.outer(cells, cells), 1))
    overlap = shared[tuple(pairs.T)] / cells[pairs].sum(axis=1)
    merged, spans_two = np.arange(len(confidence)), np.zeros(len(confidence), dtype=bool)
    for pair in pairs[np.argsort(-overlap, kind="stable")]:
        mine, theirs = (merged == merged[which] for which in pair)
        if (mine == theirs).all():
            continue
        if np.isin(view[mine], view[theirs]).any():
            spans_two[pair[cells[pair].argmax()]] = True
        else:
            merged[theirs] = merged[pair[0]]
    ones = np.ones(len(merged), dtype=np.int32)
    votes = (coo_array((ones, (merged, np.arange(len(merged))))).tocsr() @ lies).tocoo()
    order = np.lexsort((np.bincount(merged, cells)[votes.row], -votes.data, votes.col))
    first = order[np.unique(votes.col[order], return_index=True)[1]]
    shown = np.where(spans_two[number[held]], votes.row[first][cell], merged[number[held]])
    left, joined = np.unique(shown, return_inverse=True)
    best = np.zeros(len(confidence))
    np.maximum.at(best, merged, confidence)
    number = number.copy()
    number[held] = joined
    return number, best[left]


def objects_above(
    found: Segmentation,  # of N points
    above: Int64,  # (M,) which of them rise above the support
    plan: Floats,  # (M, 2) positions along the support, metres
    height: Float32,  # (N,) metres over the support
    margin: Float32,  # (N,) metres over the support up to which points belong to it
    is_cropped: bool,  # whether the cloud was cropped above the support
) -> tuple[Int64, Float64]:
    """The object (M,) of each point above the support, and the confidence (O,) of each object."""
    likely = (found.object_probability + found.support_probability)[above] > MIN_CONFIDENCE
    number, height = found.object_of_point[above], height[above]
    # The network misses thin parts, such as handles and edges: they join the object beside them.
    rows = np.flatnonzero((number < 0) & (height > margin[above] + MIN_RISE) & likely)
    held, places = subsample(np.flatnonzero(number >= 0)), np.column_stack([plan, height])
    apart, nearest = cKDTree(places[held]).query(places[rows], distance_upper_bound=POINT_REACH)
    near = np.isfinite(apart)
    number[rows[near]] = number[held[np.asarray(nearest)[near]]]
    first = len(found.confidence)
    # If there are objects, background stays background: only parts that were too small are left.
    alone = not (number >= 0).any()
    among = (likely | is_cropped) & ((number == UNDECIDED) | alone)
    number = add_clusters(number, plan, among, first)
    new = np.flatnonzero(number >= first)
    which = number[new] - first
    mean = np.bincount(which, found.object_probability[above[new]]) / np.bincount(which)
    certain = np.full(len(mean), CROPPED_CONFIDENCE) if is_cropped else confidences(mean)
    certain *= 1.0 if alone or is_cropped else BESIDE_FACTOR
    number[new[certain[which] <= MIN_CONFIDENCE]] = BACKGROUND
    return number, np.concatenate([found.confidence, certain])


def add_clusters(number: Int64, plan: Floats, among: Bools, first: int) -> Int64:
    """The numbers (N,), with clusters of other points as additional objects, from `first` on.

    The network misses objects in clouds that were cropped above the support, as it does not see
    what they stand on, and small or distant objects. `plan` (N, 2) are metres along the support,
    `among` (N,) are the points that may belong to an object.
    """
    rows = np.flatnonzero((number < 0) & among)
    if len(rows) == 0:
        return number
    cell = np.floor((plan[rows] - plan[rows].min(axis=0)) / POINT_REACH).astype(np.int64)
    points = np.zeros(cell.max(axis=0) + 1)
    np.add.at(points, tuple(cell.T), 1)
    cluster, count = ndimage.label(points > 0, np.ones((3, 3)))
    which = np.arange(1, count + 1)
    large = ndimage.sum_labels(points > 0, cluster, which) >= MIN_CLUSTER_CELLS
    large &= ndimage.mean(points, cluster, which) >= MIN_CELL_POINTS
    new = np.full(count + 1, UNDECIDED)
    new[1:][large] = first + np.arange(large.sum())
    number = number.copy()
    number[rows] = new[cluster[tuple(cell.T)]]
    return number


def drop_long_objects(number: Int64, points: Float32, max_size: float) -> Int64:
    """The numbers (N,), with objects longer than `max_size` metres turned into background."""
    held = np.flatnonzero(number >= 0)
    if len(held) == 0:
        return number
    order = held[np.argsort(number[held], kind="stable")]
    starts = np.flatnonzero(np.diff(number[order], prepend=-1))
    number = number.copy()
    for rows in np.split(order, starts[1:]):
        some = points[subsample(rows, 500)].astype(np.float64)
        around = some - some.mean(axis=0)
        _, axes = np.linalg.eigh(around.T @ around)
        low, high = np.percentile(around @ axes, (1, 99), axis=0)
        if (high - low).max() > max_size:
            number[rows] = BACKGROUND
    return number


@compiled("contract")
def _label_points(
    points: Float32,  # (N, 3) cloud frame, metres
    turn: Float64,  # (3, 3) to the camera's frame
    origin: Float64,  # (3,) the camera's position, along the axes of its frame
    corner: Float64,  # (2,) of the image, as in `RangeImage`
    pixels: Pixels,
    of_pixel: Int64,  # (H, W) the object of each
) -> tuple[Int64, Float32, Float32]:
    """Label points (N,) by the nearest output pixel around each, if one is near enough.

    Returns its object, and its probabilities of an object and of a support.
    """
    seen, classes = pixels.points, pixels.classes
    rows, columns, _ = seen.shape
    number = np.full(len(points), UNDECIDED)
    objects, support = np.zeros((2, len(points)), np.float32)
    T, t = turn.astype(np.float32), origin.astype(np.float32)
    per_pixel = np.float32(1.0 / pixels.footprint)
    left, top = np.float32(corner[0]) * per_pixel, np.float32(corner[1]) * per_pixel
    reach = np.float32(POINT_REACH)
    for n in range(len(points)):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c - t[2]
        if z < NEAREST_DEPTH:
            continue
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c - t[0]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c - t[1]
        per_metre = per_pixel / z
        u, v = x * per_metre - left, y * per_metre - top
        if u < 0 or v < 0 or u >= columns or v >= rows:
            continue
        i, j = int(v), int(u)
        nearest, row, column = (reach + reach * z) ** 2, -1, -1
        for k in range(i, min(i + 2, rows)):
            for m in range(j, min(j + 2, columns)):
                dx, dy, dz = seen[k, m, 0] - x, seen[k, m, 1] - y, seen[k, m, 2] - z
                away = dx * dx + dy * dy + dz * dz
                if away < nearest:  # false for NaN
                    nearest, row, column = away, k, m
        if row >= 0:
            number[n] = of_pixel[row, column]
            objects[n], support[n] = classes[2, row, column], classes[1, row, column]
    return number, objects, support
