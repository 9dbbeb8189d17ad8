"""A request's scene on a device; `edgegrasp_model.scene` in tensors."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from edgegrasp_model.canonical_frame import CanonicalFrame
from edgegrasp_model.cloud import Cloud, Voxels
from edgegrasp_model.cloud_input import CheckedCloud
from edgegrasp_model.obstacles import SolidBoxes
from edgegrasp_model.on_device.cloud import (
    DeviceCloud,
    DeviceVoxels,
    estimate_normals,
    inliers,
    orient_normals,
    voxelise,
)
from edgegrasp_model.on_device.constants import constant
from edgegrasp_model.options import DetectOptions
from edgegrasp_model.regions import Region, inside_region
from edgegrasp_model.scene import (
    MIN_NORMAL,
    MIN_POINTS,
    Scene,
    at_workspace_side,
    check_viewpoints,
    cut_out,
    only_viewpoint,
    plane_in_frame,
)
from edgegrasp_model.support import SupportPlane

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class DeviceScene:
    """What grasps are looked for in; canonical frame. V points are left of the cloud."""

    frame: CanonicalFrame
    cloud: DeviceCloud  # V points
    points_in_cloud: Tensor  # (V, 3) the same in the cloud's frame
    approach_allowed: Tensor  # (V,) in the approach region
    contact_allowed: Tensor  # (V,) in the contact region
    support: SupportPlane | None
    obstacles: SolidBoxes
    viewpoint: NDArray[np.float32] | None  # (3,) the camera, where there is one and only one
    at_side: Tensor | None  # (V,) where a side of the workspace cuts the cloud off

    @cached_property
    def on_processor(self) -> Scene:
        """The same in arrays, without the rows of the cloud as sent."""
        at_side = self.at_side
        return Scene(
            frame=self.frame,
            cloud=Cloud(self.cloud.points.cpu().numpy(), self.cloud.normals.cpu().numpy()),
            points_in_cloud=self.points_in_cloud.cpu().numpy(),
            point_of_row=np.empty(0, dtype=np.int64),
            approach_allowed=self.approach_allowed.cpu().numpy(),
            contact_allowed=self.contact_allowed.cpu().numpy(),
            support=self.support,
            obstacles=self.obstacles,
            viewpoint=self.viewpoint,
            at_side=None if at_side is None else at_side.cpu().numpy(),
        )


def build_scene(
    sent: CheckedCloud,
    options: DetectOptions,
    voxel_size: float,
    counts: dict[str, int],
    warnings: list[str],
    device: torch.device,
) -> DeviceScene | None:
    """As `edgegrasp_model.scene.build_scene`, on a device.

    Cutting the cloud to the workspace and off its support comes before the upload, and with it the
    search for the plane. Regions are looked up on the processor.

    Raises:
        InvalidRequest: As there.
    """
    viewpoints = check_viewpoints(sent, options)
    sent, support = cut_out(sent, viewpoints, options, counts, warnings)
    if len(sent.points) == 0:
        counts |= {"voxels": 0, "kept": 0}
        return None
    first_viewpoint = None if viewpoints is None else viewpoints[0]
    frame = CanonicalFrame.of_scene(sent.points, options.up, first_viewpoint)
    T_canonical_cloud = _uploaded(frame.T_canonical_cloud, device)
    turn, shift = T_canonical_cloud[:3, :3], T_canonical_cloud[:3, 3]
    voxels = voxelise_in_frame(sent, turn, shift, voxel_size)
    middles = voxels.middles
    counts["voxels"] = len(middles)
    kept = inliers(middles).nonzero().squeeze(1)
    counts["kept"] = len(kept)
    if counts["kept"] < MIN_POINTS:
        return None
    points = middles[kept]
    normals = _normals(sent, points, kept, voxels.voxels, frame, viewpoints)
    in_cloud = ((middles.double() - shift) @ turn).float()

    def inside(region: Region | None) -> Tensor:
        if region is None:
            return torch.ones(len(kept), dtype=torch.bool, device=device)
        here = Voxels(*(part.cpu().numpy() for part in voxels.voxels))
        held = inside_region(region, in_cloud.cpu().numpy(), here, sent)
        return torch.from_numpy(held).to(device)[kept]

    approach = inside(options.approach_region)
    counts["in_approach_region"] = int(approach.sum())
    points_in_cloud, at_side = in_cloud[kept], None
    if options.workspace is not None:
        beside = at_workspace_side(points_in_cloud.cpu().numpy(), options.workspace, options.up)
        at_side = torch.from_numpy(beside).to(device)
    return DeviceScene(
        frame=frame,
        cloud=DeviceCloud(points, normals),
        points_in_cloud=points_in_cloud,
        approach_allowed=approach,
        contact_allowed=inside(options.contact_region),
        support=None if support is None else plane_in_frame(support, frame),
        obstacles=SolidBoxes.from_shapes(options.collision.obstacles, frame),
        viewpoint=only_viewpoint(viewpoints, frame),
        at_side=at_side,
    )


@dataclass(frozen=True)
class _VoxelCloud:
    voxels: DeviceVoxels
    middles: Tensor  # (V, 3) float32


def voxelise_in_frame(
    sent: CheckedCloud, turn: Tensor, shift: Tensor, voxel_size: float
) -> _VoxelCloud:
    """Upload a cloud and sort it into the voxels of the frame that `turn` and `shift` lead to."""
    points = _uploaded(sent.points, turn.device).double() @ turn.T + shift
    voxels = voxelise(points, voxel_size)
    return _VoxelCloud(voxels, voxels.mean(points))


def _normals(
    sent: CheckedCloud,
    points: Tensor,
    kept: Tensor,
    voxels: DeviceVoxels,
    frame: CanonicalFrame,
    viewpoints: Float64 | None,
) -> Tensor:
    """Unit normals (V, 3) of the kept voxels: those given, else estimated, turned to the camera."""
    device = points.device
    if viewpoints is None:  # one metre above the cloud's middle
        seen_from = (points.amin(dim=0) + points.amax(dim=0)) / 2
        seen_from = seen_from + constant((0.0, 0.0, 1.0), device)
    else:
        seen_from = _uploaded(frame.points(viewpoints).astype(np.float32), device)
        if len(viewpoints) > 1 and sent.view_ids is not None:
            labels = _uploaded(sent.view_ids, device)
            seen_from = seen_from[voxels.commonest(labels, len(viewpoints))[kept]]
    normals = orient_normals(points, estimate_normals(points), seen_from)
    if sent.normals is None:
        return normals
    own = _uploaded(sent.normals, device)
    own = own / own.norm(dim=1, keepdim=True).clamp_min(1e-12)
    turn = _uploaded(frame.T_canonical_cloud[:3, :3], device)
    given = voxels.mean(own)[kept].double() @ turn.T
    length = given.norm(dim=1, keepdim=True)
    return torch.where(length >= MIN_NORMAL, given / length.clamp_min(MIN_NORMAL), normals).float()


def _uploaded(values: ArrayLike, device: torch.device) -> Tensor:
    array = np.ascontiguousarray(values)
    # A message's own bytes are read-only, which PyTorch warns of.
    return torch.from_numpy(array if array.flags.writeable else array.copy()).to(device)
