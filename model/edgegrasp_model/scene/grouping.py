"""From what the `scene` network says of each pixel to objects, and how sure each of them is."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from edgegrasp_camera.arrays import Float32, Float64, Int64
from edgegrasp_model.kernels import compiled

# In place of an object's number: background; what may belong to an object.
FIXED, UNKNOWN = -1, -2


@dataclass(frozen=True)
class GroupingLimits:
    """When pixels show the same object."""

    link: float = 0.5  # probability that neighbouring pixels show one object
    jump: float = 0.035  # metres of depth between neighbours, as to a wrong reading before it
    centre: float = 0.035  # metres between the mean votes of two parts of one object
    smallest: int = 20  # pixels of an object, in the network's output
    smallest_area: float = 5e-4  # square metres, as seen
    smooth: float = 0.97  # cosine between normals of neighbours on one smooth surface
    step: float = 3.0  # pixels between neighbours on one smooth surface
    view_cell: float = 0.01  # metres, in which the views of one object lie in the same place
    view_share: float = 0.25  # of the smaller one's cells that two views of one object share


LIMITS = GroupingLimits()


class Pixels(NamedTuple):
    """What the network says of the pixels of its output, and what they show; camera frame."""

    points: Float32  # (H, W, 3) metres; NaN where nothing was seen
    normals: Float32  # (H, W, 3) unit; 0 where unknown
    classes: Float32  # (3, H, W) probabilities
    votes: Float32  # (H, W, 3) metres from each point to the centre of its object
    links: Float32  # (2, H, W) probability of showing the same object as the right, lower pixel
    footprint: float  # metres, width of a pixel at a depth of one metre


def group(pixels: Pixels) -> Int64:
    """The object (H, W) of each pixel, from 0; FIXED where it shows none, UNKNOWN in doubt."""
    points, _, classes, votes, links, footprint = pixels
    seen = ~np.isnan(points[..., 2])
    held = seen & (classes.argmax(axis=0) == 2)
    number = np.where(held, UNKNOWN, FIXED)
    if not held.any():
        return number
    centre = points + votes
    index, pairs, strength = np.arange(held.size).reshape(held.shape), [], []
    right, lower = (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1, :], np.s_[1:, :])  # neighbours
    for link, (first, second) in zip(links, (right, lower), strict=True):
        near = np.abs(points[first][..., 2] - points[second][..., 2]) < LIMITS.jump
        joined = held[first] & held[second] & (link[first] > LIMITS.link) & near
        pairs.append(np.stack([index[first][joined], index[second][joined]], axis=1))
        strength.append(link[first][joined])
    order = np.argsort(-np.concatenate(strength), kind="stable")
    component = np.arange(held.size)
    flat = np.nan_to_num(centre.reshape(-1, 3)).astype(np.float64)
    _join(np.concatenate(pairs)[order], component, flat.copy(), LIMITS.smallest, LIMITS.centre)
    rows = np.flatnonzero(held)
    _, part, count = np.unique(component[rows], return_inverse=True, return_counts=True)
    flat = flat[rows]
    mean = np.stack([np.bincount(part, flat[:, d]) for d in range(3)], axis=1) / count[:, None]
    area = np.bincount(part, (points[..., 2].reshape(-1)[rows] * footprint) ** 2)
    large = np.flatnonzero((count >= LIMITS.smallest) & (area >= LIMITS.smallest_area))
    if len(large) == 0:
        return number
    # Parts that something in front separates vote for one centre.
    apart = np.linalg.norm(mean[large, None] - mean[large], axis=-1)
    _, merged = connected_components(apart < LIMITS.centre, directed=False)
    of_part = np.full(len(count), UNKNOWN)
    of_part[large] = merged
    number.reshape(-1)[rows] = of_part[part]
    return number


@compiled()
def _join(pairs: Int64, component: Int64, centre: Float64, large: int, apart: float) -> None:
    """Join pairs (P, 2) of pixels in order, but not two large parts with different centres.

    One weak link then does not join two objects (Kruskal's algorithm, with that exception).

    Args:
        pairs: Those that most probably show one object first.
        component: (N,) each pixel; becomes the part that it belongs to.
        centre: (N, 3) metres, what each pixel votes for; overwritten by sums.
        large: Pixels of a large part.
        apart: Metres between centres.
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
        if count[a] >= large and count[b] >= large:
            away = 0.0
            for d in range(3):
                away += (centre[a, d] / count[a] - centre[b, d] / count[b]) ** 2
            if away > apart * apart:
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


def instance_traits(number: Int64, pixels: Pixels) -> Float64:
    """What tells objects from patches of background that the network calls one.

    Args:
        number: (H, W) as from `group`, of O objects.
        pixels: The same.

    Returns:
        (O, 3) 1, the mean probability of an object, and the share of the border on which the
        surface runs on smoothly into what is no object.
    """
    points, normals, classes, _, _, footprint = pixels
    count = int(number.max(initial=-1)) + 1
    held = number >= 0
    size = np.bincount(number[held], minlength=count)
    mean = np.bincount(number[held], classes[2][held], minlength=count) / np.maximum(size, 1)
    border, smooth = np.zeros((2, count))
    near = LIMITS.step * footprint * np.nan_to_num(points[..., 2])
    for a, b in (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:]):
        step = np.linalg.norm(points[a] - points[b], axis=-1) < near[a]  # false for NaN
        along = (normals[a] * normals[b]).sum(axis=-1) > LIMITS.smooth
        for inside, outside in ((a, b), (b, a)):
            edge = (number[inside] >= 0) & (number[outside] != number[inside])
            edge &= ~np.isnan(points[outside][..., 2])
            border += np.bincount(number[inside][edge], minlength=count)
            runs_on = edge & step & along & (number[outside] < 0)
            smooth += np.bincount(number[inside][runs_on], minlength=count)
    share = smooth / np.maximum(border, 1)
    return np.stack([np.ones(count), mean, share], axis=1)


def joined(points: Float32, number: Int64, count: int) -> Int64:
    """The new number (O,) of each of the numbers (N,): objects in the same place become one."""
    held = np.flatnonzero(number >= 0)
    if len(held) == 0:
        return np.arange(count)
    cell = np.floor(points[held] / LIMITS.view_cell).astype(np.int64)
    cell -= cell.min(axis=0)
    size = cell.max(axis=0) + 1
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    _, key = np.unique(key, return_inverse=True)
    shape = count, int(key.max()) + 1
    lies = coo_array((np.ones(len(held), dtype=np.int32), (number[held], key)), shape).tocsr()
    lies.data[:] = 1
    shared = (lies @ lies.T).toarray()
    cells = np.diag(shared)
    same = shared >= LIMITS.view_share * np.maximum(np.minimum.outer(cells, cells), 1)
    same &= shared > 0
    return np.asarray(connected_components(same, directed=False)[1])
