"""The `scene` network: classifies pixels of a range image and links pixels of the same object.

The range image is rendered from points, as seen from a viewpoint.

The network is a U-Net on depth alone, like networks that segment unseen objects from simulated
depth (UOIS-Net, Xie et al., T-RO 2021). Its input has twice the resolution of its output.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from edgegrasp_camera.arrays import Float32, Float64
from edgegrasp_model.kernels import compiled
from edgegrasp_model.scene.cloud import (
    LARGE_IMAGE,
    MAX_VIEW_TANGENT,
    OUTLIER_PERCENT,
    SUBSAMPLE_SIZE,
    subsample,
    unit,
    usual_up,
)

CLASSES = ("other", "support", "object")
INPUT_CHANNELS = 12  # of `scene_features`
LAYER_WIDTHS = (16, 32, 48, 64, 96, 128)  # channels at each resolution, the output's first
VOTE_UNIT = 0.05  # metres
# For networks that tolerate its rounding, on processors that multiply it twice as fast.
_FAST = torch.cpu._is_avx512_bf16_supported() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
FAST = torch.bfloat16 if _FAST else torch.float32


class SceneOutput(NamedTuple):
    """The network's output for each pixel, at half the input's resolution."""

    classes: Tensor  # (B, 3, H/2, W/2) logits of CLASSES
    votes: Tensor  # (B, 3, H/2, W/2) metres from the point to the centre of its object
    links: Tensor  # (B, 2, H/2, W/2) logits: same object as the right, the lower neighbour
    up: Tensor  # (B, 3, H/2, W/2) direction away from gravity, of any length


class SceneNet(nn.Module):
    """Predicts classes, votes for object centres, links between pixels, and the up direction."""

    def __init__(self) -> None:
        super().__init__()
        first, last, pairs = LAYER_WIDTHS[0], LAYER_WIDTHS[-1], list(pairwise(LAYER_WIDTHS))
        self.stem = _layer(INPUT_CHANNELS, first, kernel=4, stride=2)
        self.fine = _layer(first, first)
        self.down = nn.ModuleList(
            [nn.Sequential(_layer(a, b, stride=2), _Block(b)) for a, b in pairs]
        )
        self.context = _Block(last, dilation=3)
        self.across = nn.ModuleList([nn.Conv2d(b, a, 1) for a, b in pairs[::-1]])
        self.up = nn.ModuleList([_layer(a, a) for a, _ in pairs[::-1]])
        self.head = nn.Conv2d(first, len(CLASSES) + 3 + 2 + 3, 1)  # as in SceneOutput

    def forward(self, features: Tensor) -> SceneOutput:
        """Maps features (B, INPUT_CHANNELS, H, W); H and W are multiples of 32."""
        x = self.fine(self.stem(features))
        kept = []
        for layer in self.down:
            kept.append(x)
            x = layer(x)
        x = self.context(x)
        for across, layer, beside in zip(self.across, self.up, kept[::-1], strict=True):
            x = functional.interpolate(across(x), size=beside.shape[2:], mode="bilinear")
            x = layer(x + beside)
        out = self.head(x).float()  # the rest may be in bfloat16
        return SceneOutput(out[:, :3], VOTE_UNIT * out[:, 3:6], out[:, 6:8], out[:, 8:])

    def fused(self) -> "SceneNet":
        """This network with every normalisation folded into its convolution, for inference."""
        for module in self.modules():
            if isinstance(module, nn.Sequential) and isinstance(module[0], nn.Conv2d):
                normalisation = module[1]
                assert isinstance(normalisation, nn.BatchNorm2d)
                module[0] = fuse_conv_bn_eval(module[0], normalisation)
                module[1] = nn.Identity()
        return self


class _Block(nn.Module):
    """Residual block of two convolutions."""

    def __init__(self, width: int, dilation: int = 1) -> None:
        super().__init__()
        self.first = _layer(width, width, dilation=dilation)
        self.second = _layer(width, width, dilation=dilation)[:2]  # without its ReLU

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.second(self.first(x)))


def _layer(
    inside: int, outside: int, kernel: int = 3, stride: int = 1, dilation: int = 1
) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inside, outside, kernel, stride, padding=dilation, dilation=dilation, bias=False),
        nn.BatchNorm2d(outside),
        nn.ReLU(inplace=True),
    )


# Range images

NEAREST_DEPTH = 0.05  # metres from the viewpoint
PIXEL_SPACING = 1.25  # side of a pixel, in spacings of sparse points, so that few pixels are empty
MAX_HOLE_SPACING = 1.6  # point spacing, in pixels, up to which holes are filled by interpolation
MIN_FILLED = 0.93  # share of the pixels between two filled ones that is filled; else enlarge pixels
# Metres at the median depth: larger pixels are divided; pixels below half of this show noise.
MAX_PIXEL_SIZE = 0.003
SURFACE_DEPTH = 0.02  # metres; a point this much nearer hides another one in the same pixel


class RangeImage(NamedTuple):
    """An image of points in the frame of a camera (x right, y down, z forward) at a viewpoint."""

    points: Float32  # (H, W, 3) metres; NaN where nothing was seen
    footprint: float  # metres, width of a pixel at a depth of one metre
    R_camera_cloud: Float64  # (3, 3) rows: the camera's axes in the cloud's frame
    corner: Float64  # (2,) x / z and y / z of the upper left corner


def range_image(
    points: Float32,  # (N, 3) cloud frame, metres; at least one
    viewpoint: Float64,  # (3,) of the camera
    up: Float64 | None,  # (3,) away from gravity, drawn upward; None: unknown
    # (3,) downward in the image, used if `up` is unknown or the line of sight; None: usual down
    down: Float64 | None,
) -> RangeImage:
    """Render points as seen from a viewpoint."""
    downward = [*([] if up is None else [-up]), *([] if down is None else [unit(down)])]
    # An integer step that divides the width of an image would always skip its last columns.
    step = max(0.9983 * (len(points) // SUBSAMPLE_SIZE), 1.0)
    apart = points[np.arange(0.0, len(points), step).astype(np.int64)] - viewpoint
    sight = unit(apart)
    # Rounded, so that the image is independent of the order of the points.
    turn = _camera_axes(sight.mean(axis=0).round(9), downward)
    for _ in range(2):
        low, high = _view(apart @ turn.T)
        turn = _camera_axes(np.array([*(low + high) / 2, 1.0]) @ turn, downward)
    in_view = apart @ turn.T
    low, high = _view(in_view)
    # As many pixels as a large image has with half of its rows and columns.
    finest = float(np.sqrt(4 * (high - low).prod() / np.prod(LARGE_IMAGE)))
    # Distance between neighbours at a depth of one metre, from the area of the occupied cells; 40
    # cells lie across the view.
    ahead = in_view[in_view[:, 2] > NEAREST_DEPTH]
    cell = max(float((high - low).max()) / 40, 1e-6)
    place = ((ahead[:, :2] / ahead[:, 2:] - low) / cell).astype(np.int64)
    occupied = len(np.unique(place[:, 0] * 4096 + place[:, 1])) * cell * cell
    spacing = float(np.sqrt(occupied / len(points)))
    depth = max(float(np.median(in_view[:, 2])), NEAREST_DEPTH)
    dense = spacing < MAX_HOLE_SPACING * finest
    pixel_size = max(finest, MAX_PIXEL_SIZE / 2 / depth) if dense else PIXEL_SPACING * spacing
    for growth in (1.0, 1.5, 1.5, 1.5):
        pixel_size *= growth
        sides, multiple = (high - low) / pixel_size, 2 ** (len(LAYER_WIDTHS) - 1)
        width, height = (int(np.ceil(side / multiple)) * multiple for side in sides)
        corner = (low + high) / 2 - pixel_size * np.array([width, height]) / 2
        some = subsample(points, 2 * width * height)  # more add nothing
        filled = _fill_holes(_render(some, viewpoint, turn, corner, pixel_size, (height, width)))
        seen = ~np.isnan(filled[..., 2])
        beside, above = seen[:, :-2] & seen[:, 2:], seen[:-2] & seen[2:]
        between = np.append(seen[:, 1:-1][beside], seen[1:-1][above])
        if between.sum() >= MIN_FILLED * len(between):
            break
    coarse = int(np.ceil(depth * pixel_size / MAX_PIXEL_SIZE))
    if (times := min(round(pixel_size / finest), coarse)) > 1:
        pixel_size /= times
        z = smoothly_enlarged(filled[..., 2], times)
        y, x = (np.indices(z.shape) + 0.5) * pixel_size + corner[::-1, None, None]
        filled = np.stack([x * z, y * z, z], axis=-1).astype(np.float32)
    return RangeImage(filled, pixel_size, turn, corner)


def _camera_axes(sight: Float64, downward: list[Float64]) -> Float64:
    """Axes (3, 3), rows x right, y down, z forward along `sight`; cloud frame.

    Uses the first of `downward` that is not along the line of sight.
    """
    length = float(np.linalg.norm(sight))
    z = sight / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
    choices = [*downward, -usual_up(z), np.array([1.0, 0.0, 0.0])]
    x = next(x for x in (np.cross(way, z) for way in choices) if np.linalg.norm(x) > 0.1)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _view(points: Float64) -> tuple[Float64, Float64]:
    """Lowest and highest x / z and y / z (2,) that an image of points (N, 3) covers."""
    ahead = points[points[:, 2] > NEAREST_DEPTH]
    if len(ahead) == 0:
        return np.full(2, -0.1), np.full(2, 0.1)
    ends = OUTLIER_PERCENT, 100 - OUTLIER_PERCENT
    low, high = np.percentile(ahead[:, :2] / ahead[:, 2:], ends, axis=0)
    edge = 0.02 * (high - low) + 1e-3
    low, high = np.maximum(low - edge, -MAX_VIEW_TANGENT), np.minimum(high + edge, MAX_VIEW_TANGENT)
    return low.round(9), high.round(9)


def smoothly_enlarged(depth: Float32, times: int) -> Float32:
    """Enlarge the depths (H, W), metres, of a sparse cloud to the pixel size of the training data.

    Depths are interpolated on a surface, and repeated near its edges.
    """
    nearest = depth.repeat(times, axis=0).repeat(times, axis=1)
    between = ndimage.zoom(depth, times, order=1, mode="nearest", grid_mode=True)
    smooth = np.abs(between - nearest) < SURFACE_DEPTH  # false for NaN
    return np.where(smooth, between, nearest)


@compiled("contract")
def _render(
    points: Float32,
    viewpoint: Float64,
    turn: Float64,
    corner: Float64,
    pixel_size: float,
    size: tuple[int, int],
) -> Float32:
    """For each pixel (H, W, 3), the point of the nearest surface closest to its centre, or NaN."""
    height, width = size
    pixels = np.full((height * width, 3), np.nan, np.float32)
    nearest, best = np.full((2, len(pixels)), np.inf, dtype=np.float32)
    pixel = np.full(len(points), -1, dtype=np.int32)
    depth, off = np.empty((2, len(points)), dtype=np.float32)
    for n in range(len(points)):
        x, y, z = _in_view(points[n], viewpoint, turn)
        if z < NEAREST_DEPTH:
            continue
        u = (x / z - corner[0]) / pixel_size
        v = (y / z - corner[1]) / pixel_size
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        i, j = int(v), int(u)
        pixel[n] = p = i * width + j
        depth[n], off[n] = z, (u - j - 0.5) ** 2 + (v - i - 0.5) ** 2
        nearest[p] = min(nearest[p], depth[n])
    for n in range(len(points)):
        p = pixel[n]
        if p >= 0 and depth[n] < nearest[p] + SURFACE_DEPTH and off[n] < best[p]:
            best[p] = off[n]
            pixels[p, 0], pixels[p, 1], pixels[p, 2] = _in_view(points[n], viewpoint, turn)
    return pixels.reshape(height, width, 3)


@compiled("contract")
def _fill_holes(image: Float32) -> Float32:
    """Fill each empty pixel with the mean of its neighbours if half of them exist and agree."""
    (height, width, _), out = image.shape, image.copy()
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            if not np.isnan(image[i, j, 2]):
                continue
            count, low, high = 0, np.inf, 0.0
            x = y = z = 0.0
            for k in range(-1, 2):
                for m in range(-1, 2):
                    depth = image[i + k, j + m, 2]
                    if not np.isnan(depth):
                        count += 1
                        low, high = min(low, depth), max(high, depth)
                        x += image[i + k, j + m, 0]
                        y += image[i + k, j + m, 1]
                        z += depth
            if count >= 4 and high - low < SURFACE_DEPTH + 0.01 * high:
                out[i, j, 0], out[i, j, 1], out[i, j, 2] = x / count, y / count, z / count
    return out


def scene_features(
    points: Float32,  # (H, W, 3) camera frame, metres; NaN without a reading
    up: Float64 | None,  # (3,) unit, away from gravity, camera frame; None: unknown
    footprint: float,  # width of a pixel at a depth of one metre, metres
) -> Float32:
    """The network's input (INPUT_CHANNELS, H, W) for a range image; 0 where nothing was read."""
    known = np.zeros(3) if up is None else np.asarray(up, dtype=np.float64)
    image, offset = np.ascontiguousarray(points), np.log(footprint) + 6.0
    # Channels last in memory, as the network reads them.
    return _features(image, known, up is not None, offset).transpose(2, 0, 1)


@compiled("contract")
def _features(points: Float32, up: Float64, known: bool, offset: float) -> Float32:
    height, width, _ = points.shape
    out = np.zeros((height, width, INPUT_CHANNELS), np.float32)
    middle, count = np.zeros(3), 0
    for i in range(0, height, 2):
        for j in range(0, width, 2):
            if not np.isnan(points[i, j, 2]):
                count += 1
                for d in range(3):
                    middle[d] += points[i, j, d]
    middle /= max(count, 1)
    s = 2  # pixels from each pixel to the neighbours that give its normal
    for i in range(height):
        for j in range(width):
            x, y, z = points[i, j, 0], points[i, j, 1], points[i, j, 2]
            if np.isnan(z):
                continue
            z = max(z, 0.05)
            out[i, j, 0] = min(max(2.0 * (z - middle[2]), -3.0), 3.0)
            out[i, j, 1] = log = np.log(z)
            out[i, j, 2] = log + offset
            out[i, j, 3] = x / z
            out[i, j, 4] = y / z
            if known:
                level = up[0] * (x - middle[0]) + up[1] * (y - middle[1]) + up[2] * (z - middle[2])
                out[i, j, 8] = min(max(2.0 * level, -3.0), 3.0)
                out[i, j, 10] = 1.0
            out[i, j, 11] = 1.0
            if i < s or j < s or i >= height - s or j >= width - s:
                continue
            ax = points[i + s, j, 0] - points[i - s, j, 0]
            ay = points[i + s, j, 1] - points[i - s, j, 1]
            az = points[i + s, j, 2] - points[i - s, j, 2]
            bx = points[i, j + s, 0] - points[i, j - s, 0]
            by = points[i, j + s, 1] - points[i, j - s, 1]
            bz = points[i, j + s, 2] - points[i, j - s, 2]
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length > 0.0:  # false for NaN as well
                out[i, j, 5], out[i, j, 6], out[i, j, 7] = nx / length, ny / length, nz / length
                if known:
                    out[i, j, 9] = (up[0] * nx + up[1] * ny + up[2] * nz) / length
    return out


@compiled("contract")
def _in_view(point: Float32, viewpoint: Float64, turn: Float64) -> tuple[float, float, float]:
    """A point (3,) in the camera's frame."""
    a, b, c = point[0] - viewpoint[0], point[1] - viewpoint[1], point[2] - viewpoint[2]
    return (
        turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c,
        turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c,
        turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c,
    )
