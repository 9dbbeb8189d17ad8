"""Reading the shapes of an object's URDF file and its OBJ meshes."""

import re
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from edgegrasp_camera.arrays import Float64, Int64

SIDES = 32  # sides of the prism that approximates a cylinder
BALL = 300  # points of the hull that approximates a sphere


class TriangleMesh(NamedTuple):
    """Triangles: points (P, 3), metres, and rows of them, (F, 3)."""

    points: Float64
    faces: Int64


class ObjectShape(NamedTuple):
    """An object, in the frame of its centre of mass, with the axes of its link."""

    centre: Float64  # the centre of mass in the link's frame, (3,) metres
    visible: list[TriangleMesh]  # the surfaces that a camera sees
    hulls: list[TriangleMesh]  # the convex parts that contacts use


def read_urdf(path: Path, scale: float) -> ObjectShape:
    """The shape of the first link of a URDF file, `scale` times as large.

    Raises ValueError if it cannot be read or has no solid collision shape.
    """
    centre, *surfaces = _read_urdf(path, path.stat().st_mtime_ns)
    visible, hulls = (
        [TriangleMesh(scale * points, faces) for points, faces in parts] for parts in surfaces
    )
    return ObjectShape(scale * centre, visible, hulls)


@lru_cache(maxsize=128)
def _read_urdf(path: Path, _changed: int) -> ObjectShape:
    try:
        link = ElementTree.parse(path).getroot().find("link")
        if link is None:
            raise ValueError("it has no link")
        inertial = link.find("inertial")
        centre = np.zeros(3) if inertial is None else _origin(inertial)[0]
        visible = [part for each in link.iter("visual") for part in _parts(each, path)]
        solid = [part for each in link.iter("collision") for part in _parts(each, path)]
    except (ElementTree.ParseError, ValueError, IndexError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    hulls = [hull for part in solid if (hull := convex_hull(part.points - centre)) is not None]
    if not hulls:
        raise ValueError(f"{path} has no solid collision shape")
    return ObjectShape(
        centre, [TriangleMesh(part.points - centre, part.faces) for part in visible or solid], hulls
    )


@lru_cache(maxsize=256)
def parse_obj(text: str) -> list[tuple[str, TriangleMesh]]:
    """The named objects of an OBJ file's text, with the points that their faces use."""
    points: list[list[float]] = []
    parts: list[tuple[str, list[list[int]]]] = [("", [])]  # names and triangles
    # Only points matter, not the normals and texture coordinates after the slashes.
    for line in re.sub(r"/\S*", "", text).splitlines():
        match line.split():
            case ["v", *numbers]:
                points.append([float(number) for number in numbers[:3]])
            case ["f", *corners]:  # numbers count from 1, or negative from the last point
                row = [k - 1 if k > 0 else len(points) + k for k in map(int, corners)]
                parts[-1][1].extend([row[0], *two] for two in pairwise(row[1:]))
            case ["o" | "g", *words]:
                parts.append((" ".join(words), []))
    whole, found = np.array(points), []
    for name, triangles in parts:
        if triangles:
            used, rows = np.unique(triangles, return_inverse=True)
            found.append((name, TriangleMesh(whole[used], rows.reshape(-1, 3))))
    return found


@cache
def least_width(path: Path) -> float:
    """An object's least width: between parallel planes, one of them along a face; metres."""
    hull = ConvexHull(np.concatenate([part.points for part in read_urdf(path, 1.0).hulls]))
    heights = hull.points[hull.vertices] @ hull.equations[:, :3].T
    return float(np.ptp(heights, axis=0).min())


def convex_hull(points: Float64) -> TriangleMesh | None:
    """The convex hull of points (P, 3), faces outwards; None if it has no volume."""
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    a, b, c = points[hull.simplices].transpose(1, 0, 2)
    inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0.0
    faces = np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    return TriangleMesh(points[hull.vertices], np.searchsorted(hull.vertices, faces))


def _parts(element: ElementTree.Element, urdf: Path) -> list[TriangleMesh]:
    """The surfaces of a visual or collision element, in the link's frame."""
    move, turn = _origin(element)
    shape = element.find("geometry/*")
    if shape is None:
        raise ValueError("it has an element without a geometry")
    size = np.ones(3)
    if shape.tag == "mesh":
        file = urdf.parent / shape.get("filename", "")
        if file.suffix.lower() != ".obj":
            raise ValueError(f"its mesh {file.name} is not an OBJ file; convert it")
        parts = [part for _, part in parse_obj(file.read_text(errors="replace"))]
        size = _numbers(shape, "scale", 3, "1 1 1")
    elif shape.tag == "box":
        signs = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(-1, 3)
        points = signs * _numbers(shape, "size", 3)
    elif shape.tag == "cylinder":
        angle, half = 2 * np.pi / SIDES * np.arange(SIDES), 0.5 * _numbers(shape, "length", 1)
        ring = _numbers(shape, "radius", 1) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points = np.concatenate([np.insert(ring, 2, end, axis=1) for end in (-half, half)])
    elif shape.tag == "sphere":
        z = np.linspace(-1.0, 1.0, BALL)
        angle = np.pi * (1 + 5**0.5) * np.arange(BALL)
        around = np.stack([np.cos(angle), np.sin(angle)]) * np.sqrt(1 - z * z)
        points = _numbers(shape, "radius", 1) * np.stack([*around, z], axis=1)
    else:
        raise ValueError(f"its shape {shape.tag} is unknown; use box, cylinder, sphere or mesh")
    if shape.tag != "mesh":
        parts = [hull for hull in [convex_hull(points)] if hull is not None]
    return [TriangleMesh(turn.apply(size * p) + move, faces) for p, faces in parts]


def _origin(element: ElementTree.Element) -> tuple[Float64, Rotation]:
    origin = element.find("origin")
    if origin is None:
        return np.zeros(3), Rotation.identity()
    turn = Rotation.from_euler("xyz", _numbers(origin, "rpy", 3, "0 0 0"))
    return _numbers(origin, "xyz", 3, "0 0 0"), turn


def _numbers(element: ElementTree.Element, name: str, count: int, default: str = "") -> Float64:
    text = element.get(name, default)
    if len(words := text.split()) != count:
        raise ValueError(f"{name} of its {element.tag} is {text!r}; write {count} numbers")
    return np.array([float(word) for word in words])
