"""Work on a device mixes in no tensor of the processor, and what is captured never waits for it.

PyTorch's meta device stands for a GPU: its tensors have no values, so that whoever looks at one
fails, and it refuses tensors of other devices as a GPU does.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from edgegrasp_model.canonical_frame import CanonicalFrame
from edgegrasp_model.gripper import load_gripper
from edgegrasp_model.hand_batch import HandBatch
from edgegrasp_model.hand_description import HAND_DESCRIPTION_SIZE
from edgegrasp_model.network import EdgeGraspNet, build_network
from edgegrasp_model.network_config import EDGEGRASP, HAND, VN_EDGEGRASP
from edgegrasp_model.obstacles import SolidBoxes
from edgegrasp_model.on_device import candidates, cloud, collision
from edgegrasp_model.on_device.candidates import DeviceCandidates
from edgegrasp_model.on_device.cloud import DeviceCloud, DeviceVoxels
from edgegrasp_model.on_device.constants import _constant
from edgegrasp_model.on_device.edge_network import edge_grasp_logits
from edgegrasp_model.on_device.hand_batch import _look, _seen
from edgegrasp_model.on_device.hand_description import Known
from edgegrasp_model.on_device.hand_view import DeviceView, positions
from edgegrasp_model.on_device.padded_balls import PaddedBalls
from edgegrasp_model.on_device.sampling import _spread
from edgegrasp_model.on_device.scene import DeviceScene
from edgegrasp_model.on_device.vn_network import vn_edge_grasp_logits
from edgegrasp_model.options import Collision
from edgegrasp_model.support import SupportPlane

N, E, Q = 300, 40, 50  # points, hands, places of each
SUPPORT = SupportPlane(normal=(0.0, 0.0, 1.0), offset=0.0)


def there(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.empty(*shape, dtype=dtype, device="meta")


def rows(*shape: int) -> Tensor:
    return there(*shape, dtype=torch.int64)


def mask(*shape: int) -> Tensor:
    return there(*shape, dtype=torch.bool)


@pytest.fixture(autouse=True)
def no_constants_left() -> Iterator[None]:
    yield
    _constant.cache_clear()


def scene() -> DeviceScene:
    return DeviceScene(
        frame=CanonicalFrame(np.eye(4)),
        cloud=DeviceCloud(there(N, 3), there(N, 3)),
        points_in_cloud=there(N, 3),
        approach_allowed=mask(N),
        contact_allowed=mask(N),
        support=SUPPORT,
        obstacles=SolidBoxes(np.zeros((0, 3)), np.zeros((0, 3, 3))),
        viewpoint=np.zeros(3, np.float32),
        at_side=mask(N),
    )


def of_candidates(count: int = E) -> DeviceCandidates:
    of = rows(count), rows(count), rows(count), there(count, 3), there(count), there(count, 4, 4)
    return DeviceCandidates(*of)


@pytest.mark.parametrize("config", [EDGEGRASP, VN_EDGEGRASP])
def test_the_networks_on_balls(config: Any) -> None:
    points, balls, most = 1024, 8, 256
    batch = PaddedBalls(
        points=there(points, 3),
        normals=there(points, 3),
        neighbors=rows(points, 16),
        ball_of_point=rows(points),
        members=rows(balls, most),
        contact=rows(E),
        ball_of_edge=rows(E),
        approach=there(E, 3),
        depth=there(E),
    )
    network: Any = build_network(config).to("meta")
    logits = edge_grasp_logits if isinstance(network, EdgeGraspNet) else vn_edge_grasp_logits
    with torch.inference_mode():
        found = logits(network, batch)
    assert found.shape == (E,)
    assert found.device.type == "meta"


def test_the_network_on_hands() -> None:
    network = build_network(HAND).to("meta")
    batch = HandBatch(there(E, HAND_DESCRIPTION_SIZE), there(E, 64, 6), rows(E), 3)
    with torch.inference_mode():
        assert network(batch).device.type == "meta"


def test_the_cloud() -> None:
    assert cloud.inliers(there(N, 3)).shape == (N,)
    assert cloud.estimate_normals(there(N, 3)).shape == (N, 3)
    assert cloud.orient_normals(there(N, 3), there(N, 3), there(3)).shape == (N, 3)
    voxels = DeviceVoxels(rows(500), rows(N))
    assert voxels.mean(there(500, 3)).shape == (N, 3)
    assert voxels.commonest(rows(500), 2).shape == (N,)


def test_approach_points() -> None:
    assert _spread(there(512, 3), there(512), rows(32)).shape == (32,)


@pytest.mark.parametrize("name", ["panda", "robotiq-2f-85"])
def test_candidates(name: str) -> None:
    hand = load_gripper(name)
    drawn, clear = candidates.drawn_back(of_candidates(), SUPPORT, hand, 0.01)
    assert drawn.T_cloud_hand.device.type == clear.device.type == "meta"
    assert candidates.contact_z_at(hand, there(E)).shape == (E,)


@pytest.mark.parametrize("fields", [{}, {"retreat_length": 0.1, "retreat_direction": "up"}])
def test_collisions(fields: dict[str, Any]) -> None:
    request, hand = Collision.model_validate(fields), load_gripper()
    assert collision.collides(scene(), there(E, 4, 4), hand, request).shape == (E,)


@pytest.mark.parametrize("known", [Known(True, True), Known(False, False)])
def test_what_hands_see(known: Known) -> None:
    assert positions(there(N, 3), there(E, 4, 4)).shape == (3, E, N)
    view = DeviceView(mask(E, Q), rows(E, Q), there(3, E, Q))
    seen = _seen(scene(), of_candidates(), view, load_gripper())
    assert {part.device.type for part in seen} == {"meta"}
    told = _look(load_gripper(), known, 16)(*seen)
    assert told.shape == (E, 2 + HAND_DESCRIPTION_SIZE + 6 * 16)
    assert told.device.type == "meta"


def test_that_a_tensor_of_the_processor_would_be_seen() -> None:
    with pytest.raises(RuntimeError, match="not on the expected device"):
        there(3) + torch.ones(3)
