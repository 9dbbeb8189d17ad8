"""Grasps are followed through a stream of images, over both transports."""

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.model.rendered import box, render, table, to_world

from edgegrasp_client import GraspClient, GraspTracker, InvalidRequestError
from edgegrasp_sim.camera import look_at

IMAGES = 6
STEP = 0.003  # metres along y from one image to the next
CAMERA = (0.35, 0.0, 0.55)


def image(number: int) -> dict[str, Any]:
    """A box on a table, further along in each image."""
    boxes = [table(), box((0.0, STEP * number, 0.04), (0.03, 0.02, 0.04))]
    T_world_camera = look_at(np.array(CAMERA), np.zeros(3))
    cloud = to_world(T_world_camera, render(boxes, T_world_camera, seed=number))
    points = cloud[np.isfinite(cloud).all(axis=2)].astype(np.float32)
    return {"cloud": points, "view_ids": np.zeros(len(points), np.int32)}


def test_a_grasp_keeps_its_id_and_moves_with_its_object(real_server, transport: str) -> None:
    tracker = GraspTracker(search_every=3, viewpoint=CAMERA, max_object_size=0.3)
    wanted = threading.Semaphore(1)

    def camera() -> Iterator[dict[str, Any]]:
        for number in range(IMAGES):
            wanted.acquire()
            yield image(number)

    with GraspClient(real_server.address(transport)) as client:
        found = []
        for _, detection in tracker.follow(client, camera()):
            found.append(detection)
            wanted.release()
    best = [detection.grasps[0] for detection in found]
    assert [one.tracking.first for one in found] == ["started"] + ["kept"] * (IMAGES - 1)
    assert len({(grasp.id, grasp.object) for grasp in best}) == 1
    moved = [grasp.T_cloud_hand[:3, 3] - best[0].T_cloud_hand[:3, 3] for grasp in best]
    np.testing.assert_allclose(moved, [(0, STEP * n, 0) for n in range(IMAGES)], atol=0.003)
    assert all(len({grasp.id for grasp in one.grasps}) == len(one.grasps) for one in found)
    # Only every third image is searched for other grasps.
    assert ["scored" in one.counts for one in found] == [n % 3 == 0 for n in range(IMAGES)]


def test_a_grasp_of_an_object_that_is_gone_is_lost_and_another_takes_its_place(real_server) -> None:
    with GraspClient(real_server.http_url) as client:
        first = client.detect(**image(0), viewpoint=CAMERA, previous={})
        (only,), best = first.objects, first.grasps[0]
        previous = {
            "gripper": first.gripper.name,
            "next_id": first.tracking.next_id,
            "grasps": [{"id": best.id, "T_cloud_hand": best.T_cloud_hand.ravel(), "object": 0}],
            "objects": [{"number": only.number, "surface": only.surface}],
        }
        far = image(60)
        again = client.detect(**far, viewpoint=CAMERA, previous=previous)
        assert again.tracking.first == "lost"
        assert again.grasps[0].id >= first.tracking.next_id
        assert again.objects[0].number >= first.tracking.next_id
        previous["gripper"] = "wsg-50"
        with pytest.raises(InvalidRequestError, match=r"options.previous.gripper: got 'wsg-50'"):
            client.detect(**far, previous=previous)
