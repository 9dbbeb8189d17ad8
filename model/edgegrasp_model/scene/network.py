"""The `scene` network: classifies pixels of a range image and says which belong together.

A U-Net on depth alone, as networks that segment unseen objects from simulated depth (UOIS-Net, Xie
et al., T-RO 2021): its input has twice the resolution of its output.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from edgegrasp_camera.arrays import Float32, Float64
from edgegrasp_model.kernels import compiled

HEIGHT, WIDTH = 352, 480  # pixels of the input
MULTIPLE = 32  # its sides are multiples of
CLASSES = ("other", "support", "object")
CHANNELS = 12  # of `scene_features`
WIDTHS = (16, 32, 48, 64, 96, 128)  # channels at each resolution, the output's first
STRIDE = 2  # pixels of the input between neighbours whose difference gives the normal
VOTE_UNIT = 0.05  # metres
OUTPUTS = len(CLASSES) + 3 + 2 + 3


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
        first, last, pairs = WIDTHS[0], WIDTHS[-1], list(pairwise(WIDTHS))
        self.stem = _layer(CHANNELS, first, kernel=4, stride=2)
        self.fine = _layer(first, first)
        self.down = nn.ModuleList(
            [nn.Sequential(_layer(a, b, stride=2), _Block(b)) for a, b in pairs]
        )
        self.context = _Block(last, dilation=3)
        self.across = nn.ModuleList([nn.Conv2d(b, a, 1) for a, b in pairs[::-1]])
        self.up = nn.ModuleList([_layer(a, a) for a, _ in pairs[::-1]])
        self.head = nn.Conv2d(first, OUTPUTS, 1)

    def forward(self, features: Tensor) -> SceneOutput:
        """Maps features (B, CHANNELS, H, W); H and W are multiples of 32."""
        x = self.fine(self.stem(features))
        kept = []
        for layer in self.down:
            kept.append(x)
            x = layer(x)
        x = self.context(x)
        for across, layer, beside in zip(self.across, self.up, kept[::-1], strict=True):
            x = functional.interpolate(
                across(x), size=beside.shape[2:], mode="bilinear", align_corners=False
            )
            x = layer(x + beside)
        out = self.head(x)
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


def scene_features(
    points: Float32,  # (H, W, 3) camera frame, metres; NaN without a reading
    up: Float64 | None,  # (3,) unit, away from gravity, camera frame; None: unknown
    footprint: float,  # width of a pixel at a depth of one metre, metres
) -> Float32:
    """The network's input (CHANNELS, H, W) for a range image; zero where there is no reading."""
    known = np.zeros(3) if up is None else np.asarray(up, dtype=np.float64)
    features = np.zeros((*points.shape[:2], CHANNELS), dtype=np.float32)
    _fill_features(
        np.ascontiguousarray(points), known, up is not None, np.log(footprint) + 6.0, features
    )
    return features.transpose(2, 0, 1)  # channels last in memory, as the network reads them


@compiled("contract")
def _fill_features(points: Float32, up: Float64, known: bool, offset: float, out: Float32) -> None:
    height, width, _ = points.shape
    middle, count = np.zeros(3), 0
    for i in range(0, height, 2):
        for j in range(0, width, 2):
            if not np.isnan(points[i, j, 2]):
                count += 1
                for d in range(3):
                    middle[d] += points[i, j, d]
    middle /= max(count, 1)
    s = STRIDE
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
