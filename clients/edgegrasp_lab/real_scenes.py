"""Recorded scenes with labels, and the evaluation of a detector's grasps on them.

A scene is an .npz file: docs/benchmark.md has its arrays.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.stats.contingency import crosstab

from edgegrasp_camera.arrays import Array, Bools, Float32, Float64, Int64
from edgegrasp_camera.depth import DepthView, fuse_depth_images, to_intrinsics
from edgegrasp_camera.picture import Camera
from edgegrasp_model.errors import InvalidRequest
from edgegrasp_model.gripper import Gripper

BEST = 10  # grasps of each scene that are judged
GOOD_SCORE = 0.5
FIRST_OBJECT = 2  # lower labels: 0 anything else, 1 the support plane
BELOW = 0.1  # sine of the upward angle of an approach; the detector's own limit, 6 degrees
NOISE = 0.003  # metres; 98 % of the points of a depth camera's plane lie within it at 0.6 to 0.9 m
FOUND_F = 0.75  # minimum F of a found object, as in the paper of `compare_labels`
MAX_ANGLE, MAX_OFFSET = 5.0, 0.010  # degrees, metres: maximum errors of a correct plane


@dataclass(frozen=True)
class RealScene:
    """A camera's data with labels. Camera frame, metres; R rows."""

    name: str
    request: Mapping[str, Any]  # the detector's input, as arguments of `GraspClient.detect`
    points: Float32  # (R, 3) NaN where there is no reading
    labels: Int64  # (R,) 0 anything else, 1 the support plane, 2 and up objects
    normal: Float64  # (3,) of the support plane, toward the camera; 0: it is hidden
    offset: float  # normal . x of the plane's points x
    camera: Camera
    rgb: NDArray[np.uint8] | None  # (H, W, 3)

    @property
    def objects(self) -> list[int]:
        """The labels of the objects."""
        return [int(label) for label in np.unique(self.labels) if label >= FIRST_OBJECT]

    @property
    def object_of_point(self) -> Int64:
        """(R,) number of the object that each point is on, from 1; 0 for the background."""
        return np.maximum(self.labels - FIRST_OBJECT + 1, 0)


@dataclass(frozen=True)
class Segmentation:
    """One image compared with its labels. Shares are 1 if there is nothing to compare."""

    pixel_precision: float  # share of the detected object pixels that are labelled as any object
    pixel_recall: float  # share of the labelled object pixels that are detected as any object
    overlap_precision: float  # share of the detected object pixels on the matched object
    overlap_recall: float  # share of the labelled object pixels on the matched object
    overlap_f: float  # harmonic mean of the two
    found: int  # labelled objects whose own F is FOUND_F or more
    labelled: int  # objects
    called: int  # number of detected objects


def compare_labels(labels: Int64, answer: Int64) -> Segmentation:
    """Compare an answer with labels, (R,) each: each pixel's object, 0 for the background.

    Precision, recall and F of the overlap as in Xie et al., "Unseen Object Instance Segmentation"
    (T-RO 2021): objects found and labelled are matched one to one for the greatest sum of F.
    """
    match, called, labelled, common, f = _matched(labels, answer)
    right = common[match].sum()
    precision, recall = _share(right, called.sum()), _share(right, labelled.sum())
    return Segmentation(
        pixel_precision=_share(common.sum(), called.sum()),
        pixel_recall=_share(common.sum(), labelled.sum()),
        overlap_precision=precision,
        overlap_recall=recall,
        overlap_f=2 * precision * recall / max(precision + recall, 1e-9),
        found=int((f >= FOUND_F).sum()),
        labelled=len(labelled),
        called=len(called),
    )


def renumbered(labels: Int64, answer: Int64) -> Int64:
    """The answer (R,) with the numbers of the matching labelled objects.

    Objects without a match get higher numbers.
    """
    (rows, columns), called, *_ = _matched(labels, answer)
    numbers = np.concatenate([[0], labels.max(initial=0) + 1 + np.arange(len(called))])
    numbers[rows + 1] = np.unique(labels[labels > 0])[columns]
    _, place = np.unique(np.concatenate([[0], answer]), return_inverse=True)
    return np.asarray(numbers[place[1:]])


def _matched(
    labels: Int64, answer: Int64
) -> tuple[tuple[Int64, Int64], Int64, Int64, Int64, Float64]:
    """Rows and columns (M,) of the pairs that overlap, matched for the greatest sum of F.

    Also the pixels of each detected object (C,), of each labelled object (L,) and of each pair
    (C, L), and the F of the matches (M,).
    """
    # Adds background to both, in case an image has none.
    count = crosstab(np.append(answer, 0), np.append(labels, 0)).count
    called, labelled, common = count[1:].sum(axis=1), count[:, 1:].sum(axis=0), count[1:, 1:]
    f = 2 * common / np.maximum(called[:, None] + labelled, 1)
    rows, columns = linear_sum_assignment(f, maximize=True)
    overlap = f[rows, columns] > 0
    match = rows[overlap], columns[overlap]
    return match, called, labelled, common, f[match]


def _share(part: np.integer, whole: np.integer) -> float:
    return float(part / whole) if whole else 1.0


@dataclass(frozen=True)
class PlaneFigures:
    """The found plane, compared with the labelled one."""

    angle: float  # degrees between the normals
    offset: float  # greatest distance between the planes at the foot of an object, metres
    right: bool  # whether grasps may rely on it


@dataclass(frozen=True)
class SceneFigures:
    """Evaluation of the answer for one scene: counts over its best grasps."""

    grasps: int  # in the answer
    best: int  # grasps judged, BEST at most
    on_object: int  # approach and contact point on the same object
    from_below: int  # the hand approaches from below the labelled support plane
    through_points: int  # the open hand at the grasp contains measured points
    objects: int  # in the scene
    objects_with_grasp: int  # with a grasp of GOOD_SCORE or more in the answer
    plane: PlaneFigures | None  # None: none was found
    plane_labelled: bool  # False: a heap labelled as one object, which hides the plane
    segmentation: Segmentation
    milliseconds: float  # from the request to the answer
    refused: str = ""  # the reason, if the request was refused


def load_scenes(folders: Sequence[Path]) -> list[RealScene]:
    """The scenes of folders, sorted by name in each folder.

    Raises:
        ValueError: A folder has no scene, a file is not a scene, or two have the same name; the
            message names file and fix.
    """
    files: list[Path] = []
    for folder in folders:
        found = sorted(folder.glob("*.npz"))
        if not found:
            raise ValueError(f"scenes: got {folder} without .npz files. Give a folder of scenes.")
        files += found
    names = [file.stem for file in files]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"scenes: got two scenes named {', '.join(twice)}. Rename one.")
    return [load_scene(file) for file in files]


def load_scene(file: Path) -> RealScene:
    """Read one scene; raises ValueError, with file, field and fix, if it is not a scene."""
    try:
        with file.open("rb") as opened, np.load(opened) as archive:
            arrays = dict(archive)
    except Exception as error:  # for other files numpy raises many kinds of errors
        fix = "Give what numpy.savez(file, ...) writes."
        raise ValueError(f"{file.name}: {error}. {fix}") from None
    checked = _Arrays(file.name, arrays)
    normal, offset = _plane(checked)
    try:
        request, points, camera = _cloud(checked)
    except InvalidRequest as error:
        raise ValueError(f"{file.name}: {error}") from None
    labels = checked.get("labels", "iu", "an integer from 0 for each row", points.shape[:-1])
    if labels.min(initial=0) < 0:
        checked.refuse("labels", f"a label of {labels.min()}", "integers from 0")
    labels = np.where(np.isfinite(points).all(axis=-1), labels, 0).ravel().astype(np.int64)
    if not (labels >= FIRST_OBJECT).any():
        checked.refuse("labels", "no label above 1", f"{FIRST_OBJECT} and up for the objects")
    rgb = arrays.get("rgb")
    if rgb is not None:
        checked.get("rgb", "u", "a colour of three bytes for each pixel", points.shape)
    if camera is None:  # unknown, or no camera could have seen the points
        seen = points[np.isfinite(points).all(axis=-1)].reshape(-1, 3)
        camera, rgb = (
            Camera.facing(seen, np.zeros(3), normal if normal.any() else (0, -1, 0)),
            None,
        )
    return RealScene(file.stem, request, points.reshape(-1, 3), labels, normal, offset, camera, rgb)


def judge(
    scene: RealScene,  # with its labels
    grasps: Sequence[Any],  # best first, camera frame
    # Normal (3,) and offset of the support plane that was found, camera frame.
    plane: tuple[Array, float] | None,
    answer: Int64,  # (R,) number of the object that each point is on, from 1; 0: on no object
    gripper: Gripper,  # the gripper of the grasps
    milliseconds: float,  # from the request to the answer
    refused: str = "",  # the reason, if the request was refused
) -> SceneFigures:
    """Evaluate an answer."""
    best = grasps[:BEST]
    on_object = _objects_held(scene, grasps)
    scores = np.array([grasp.score for grasp in grasps])
    well_held = {label for label in on_object[scores >= GOOD_SCORE] if label >= FIRST_OBJECT}
    apart = bool(scene.normal.any())
    upward = [float(grasp.approach_direction @ scene.normal) for grasp in best]
    called = answer if apart else np.minimum(answer, 1)
    return SceneFigures(
        grasps=len(grasps),
        best=len(best),
        on_object=int((on_object[:BEST] >= FIRST_OBJECT).sum()),
        from_below=sum(sine > BELOW for sine in upward),
        through_points=int(_meet_points(scene, best, gripper).sum()),
        objects=len(scene.objects),
        objects_with_grasp=len(well_held),
        plane=None if plane is None or not apart else _compare(scene, *plane),
        plane_labelled=apart,
        segmentation=compare_labels(scene.object_of_point, called),
        milliseconds=milliseconds,
        refused=refused,
    )


def _meet_points(scene: RealScene, grasps: Sequence[Any], gripper: Gripper) -> Bools:
    """Which open hands (E,) contain a measured point, before any cleaning, deeper than NOISE."""
    from edgegrasp_model.kernels import any_point_in_boxes, in_hands  # loads Numba

    seen = scene.points[np.isfinite(scene.points).all(axis=1)]
    hands = np.reshape([grasp.T_cloud_hand for grasp in grasps], (-1, 4, 4)).astype(np.float32)
    boxes = np.add(gripper.boxes(gripper.max_opening), [[NOISE], [-NOISE]])
    return any_point_in_boxes(in_hands(seen, hands), boxes)


def _objects_held(scene: RealScene, grasps: Sequence[Any]) -> Int64:
    """The label (E,) of the object that both points of a grasp are on; 0 if there is none."""
    seen = np.isfinite(scene.points).all(axis=1)
    ends = [(grasp.approach_point, grasp.contact_point) for grasp in grasps]
    # Points of a grasp are voxel means, which are near a measured point, but not on it.
    _, row = cKDTree(scene.points[seen]).query(np.asarray(ends).reshape(-1, 2, 3))
    label = scene.labels[seen][row]  # (E, 2)
    same = (label[:, 0] == label[:, 1]) & (label[:, 0] >= FIRST_OBJECT)
    return np.where(same, label[:, 0], 0)


def _compare(scene: RealScene, normal: Array, offset: float) -> PlaneFigures:
    cosine = float(np.clip(np.asarray(normal, dtype=np.float64) @ scene.normal, -1.0, 1.0))
    angle = float(np.degrees(np.arccos(cosine)))
    of_objects = [scene.points[scene.labels == label] for label in scene.objects]
    middles = np.array([np.nanmedian(points, axis=0) for points in of_objects])
    height = middles.astype(np.float64) @ scene.normal - scene.offset
    feet = middles - height[:, None] * scene.normal
    apart = float(np.abs(feet @ normal - offset).max())
    return PlaneFigures(angle, apart, angle <= MAX_ANGLE and apart <= MAX_OFFSET)


class _Arrays(NamedTuple):
    """The arrays of a file; an invalid one raises ValueError."""

    file: str
    arrays: Mapping[str, Array]

    def get(
        self, field: str, kinds: str, wanted: str, shape: tuple[int, ...] | None = None
    ) -> Array:
        """An array of one of these dtype kinds and, if given, of a shape."""
        if field not in self.arrays:
            self.refuse(field, "nothing", wanted)
        array = self.arrays[field]
        if array.dtype.kind not in kinds or shape not in (None, array.shape):
            self.refuse(field, f"shape {array.shape}, dtype {array.dtype}", wanted)
        return array

    def refuse(self, field: str, value: str, wanted: str) -> NoReturn:
        raise ValueError(f"{self.file}: {field}: got {value}. Save {wanted}.")


def _plane(arrays: _Arrays) -> tuple[Float64, float]:
    """Normal (3,) and offset of the support plane; 0 if the file has neither."""
    if not {"support_normal", "support_offset"} & arrays.arrays.keys():
        return np.zeros(3), 0.0
    normal = arrays.get("support_normal", "fiu", "three numbers, of length 1", (3,))
    if not abs(np.linalg.norm(normal) - 1.0) <= 1e-3:  # nor NaN
        arrays.refuse("support_normal", f"length {np.linalg.norm(normal):g}", "a unit normal")
    offset = float(arrays.get("support_offset", "fiu", "one number, metres", ()))
    if not offset < 0.0:
        arrays.refuse("support_offset", f"{offset:g}, a camera below", "a plane with its normal up")
    return normal.astype(np.float64), offset


def _cloud(arrays: _Arrays) -> tuple[dict[str, Any], Float32, Camera | None]:
    """The detector's input, points (H, W, 3) or (N, 3), NaN without a reading, and the camera."""
    if "depth" in arrays.arrays:
        depth = arrays.get("depth", "u", "(H, W) uint16 millimetres")
        values = arrays.get("intrinsics", "fiu", "fx, fy, cx, cy beside depth", (4,)).tolist()
        view = DepthView(to_intrinsics(values))
        points = np.asarray(fuse_depth_images([depth], [view]).points, dtype=np.float32)
        camera = Camera((depth.shape[0], depth.shape[1]), *values)
        return {"depth_images": [{"depth": depth, "intrinsics": values}]}, points, camera
    wanted = "(H, W, 3) or (N, 3) float32 metres, or depth and intrinsics"
    points = arrays.get("points", "f", wanted)
    if points.ndim not in (2, 3) or points.shape[-1] != 3:
        arrays.refuse("points", f"shape {points.shape}", wanted)
    points = points.astype(np.float32)
    request = {"cloud": points, "viewpoint": (0.0, 0.0, 0.0)}
    return request, points, Camera.from_image(points) if points.ndim == 3 else None
