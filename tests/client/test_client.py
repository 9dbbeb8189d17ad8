"""One API, either transport, synchronous or not: the same values and the same exceptions."""

import asyncio
import dataclasses
import itertools
import os
import sys
import threading
from base64 import b64encode
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.cloud_files import ply
from tests.many_options import MANY, OWN_GRIPPER

import edgegrasp_client as api
from edgegrasp_client import AsyncGraspClient, Detection, GraspClient, GraspTracker, StreamRequest
from edgegrasp_results import FoundSupport


def assert_same(found: Detection, expected: Detection) -> None:
    assert len(found.grasps) == len(expected.grasps) > 0
    for ours, theirs in zip(found.grasps, expected.grasps, strict=True):
        for field in dataclasses.fields(ours):
            left, right = getattr(ours, field.name), getattr(theirs, field.name)
            np.testing.assert_array_equal(left, right)
            assert type(left) is type(right)


def test_both_transports_give_the_same_values(dummy_server, make_client, cloud) -> None:
    by_grpc = make_client(dummy_server.grpc_address).detect(cloud, seed=3)
    by_rest = make_client(dummy_server.http_url).detect(cloud, seed=3)
    assert_same(by_grpc, by_rest)
    assert (by_grpc.counts, by_grpc.model) == (by_rest.counts, "dummy")
    assert by_grpc.warnings == by_rest.warnings != []
    assert by_grpc.seconds.keys() == by_rest.seconds.keys() >= {"total"}
    grasp = by_grpc.grasps[0]
    assert grasp.T_cloud_hand.shape == grasp.T_cloud_tcp.shape == (4, 4)
    assert grasp.T_cloud_hand.dtype == grasp.contact_point.dtype == np.float32


def test_files_and_arrays_give_the_same(client, cloud, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", cloud)
    np.savez(tmp_path / "a.npz", points=cloud)
    (tmp_path / "a.PLY").write_bytes(ply(cloud, "ascii"))
    expected = client.detect(cloud)
    for given in (cloud.astype(np.float64), np.asfortranarray(cloud), cloud[::-1][::-1]):
        assert_same(client.detect(given), expected)
    for name in ("a.npy", "a.npz", "a.PLY"):
        assert_same(client.detect(tmp_path / name), expected)
        assert_same(client.detect(str(tmp_path / name)), expected)


# As arrays and numbers of NumPy too.
OWN = OWN_GRIPPER | {"name": "mine", "max_opening": np.float32(0.07), "swing": None}
OWN["finger"] = {"boxes": np.array(OWN_GRIPPER["finger"]["boxes"])}
ALL_OPTIONS: dict[str, Any] = MANY | {
    "model": "dummy",
    "gripper": OWN,
    "num_approach_points": np.int64(12),
    "viewpoint": np.array([0.1, 0.2, 0.7], np.float32),
    "objects": {"include": np.array([0, 2]), "exclude": range(1, 2)},
    "at": (3, 4.5),
    "near": np.array([0.1, 0.2, 0.3]),
    "max_object_size": 0.3,
    "approach_region": {"include": [{"kind": "mask", "mask": np.arange(500) % 2 == 0}]},
    "top_k": 3,
    "previous": {
        "gripper": "panda",
        "next_id": 8,
        "grasps": [{"id": 7, "T_cloud_hand": np.eye(4).ravel(), "object": np.int64(3)}],
        "objects": [{"number": 3, "surface": np.zeros((2, 3), np.float32), "confidence": None}],
        "search": True,
    },
}


def test_every_option_goes_through_and_none_is_its_default(client, cloud) -> None:
    known = api.DetectOptions.__annotations__.keys()
    assert ALL_OPTIONS.keys() == known - {"robot"}  # which this server has none of: tests/robot
    detection = client.detect(cloud, **ALL_OPTIONS)
    assert len(detection.grasps) == 3
    assert detection.counts["scored"] == 12
    alone = {name: client.detect(cloud, **{name: value}) for name, value in ALL_OPTIONS.items()}
    assert len(alone["top_k"].grasps) == 3
    assert_same(client.detect(cloud, **dict.fromkeys(ALL_OPTIONS)), client.detect(cloud))
    region = {"include": [{"kind": "mask", "mask": b64encode(np.arange(500) % 2 == 0).decode()}]}
    assert_same(client.detect(cloud, approach_region=region), alone["approach_region"])


def test_models_and_readiness(client) -> None:
    (model,) = client.models()
    assert (model.name, model.default, model.gripper) == ("dummy", True, "panda")
    assert client.ready()
    client.wait_until_ready(5)


async def test_concurrent_requests_get_their_own_answers(dummy_server, transport, client, cloud):
    async with AsyncGraspClient(dummy_server.address(transport)) as asynchronous:
        detections = await asyncio.gather(*(asynchronous.detect(cloud, seed=s) for s in range(8)))
    assert len({tuple(d.grasps[0].contact_point) for d in detections}) > 1
    for seed, detection in enumerate(detections):
        assert_same(detection, client.detect(cloud, seed=seed))


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")  # of several threads
@pytest.mark.parametrize("kind", [GraspClient, AsyncGraspClient])
def test_a_forked_process_asks_over_rest_alone(kind: Any, dummy_server, cloud) -> None:
    async def of_fork() -> None:
        kind(dummy_server.grpc_address)

    with GraspClient(dummy_server.grpc_address) as client:
        assert client.detect(cloud).grasps
        child = os.fork()
        if child == 0:
            with GraspClient(dummy_server.http_url) as of_child:
                found = bool(of_child.detect(cloud).grasps)
            try:
                asyncio.run(of_fork())
            except api.InvalidRequestError:
                try:
                    client.detect(cloud)  # its connection is its parent's
                except api.GraspClientError as error:
                    os._exit(0 if found and "another process" in str(error) else 2)
            os._exit(1)
        assert os.waitpid(child, 0)[1] == 0
        assert client.detect(cloud).grasps


def test_poses_before_and_after_a_grasp(client, cloud) -> None:
    detection = client.detect(cloud, top_k=1, gripper="robotiq-2f-85")
    (grasp,), up = detection.grasps, detection.up
    hand = grasp.T_cloud_hand
    for moved, way in (
        (grasp.pregrasp(0.1), -0.1 * hand[:3, 2]),
        (grasp.retreat(0.2), -0.2 * hand[:3, 2]),
        (grasp.retreat(0.3, 2 * up), 0.3 * up),
    ):
        np.testing.assert_allclose(moved[:3, 3] - hand[:3, 3], way, atol=1e-6)
        np.testing.assert_array_equal(moved[:3, :3], hand[:3, :3])
    assert detection.gripper.name == "robotiq-2f-85"


def test_a_mask_narrows_the_regions_that_are_asked_for() -> None:
    ball = {"kind": "sphere", "center": [0, 0, 0.5], "radius": 0.1}
    asked = {"top_k": 3, "contact_region": {"include": [ball]}}
    mask = np.zeros((2, 3, 4), np.uint8)
    mask[0, 1, 2] = 255  # red, green, blue
    mask[1, 2, 3] = 255  # transparency says nothing
    options = api.on_mask(mask, asked)
    assert options["top_k"] == 3
    assert options["contact_region"]["include"] == [ball]
    (outside,) = options["contact_region"]["exclude"]
    np.testing.assert_array_equal(outside["mask"], [[True, False, True], [True] * 3])
    (inside,) = options["approach_region"]["include"]
    np.testing.assert_array_equal(inside["mask"], [[False, True, False], [False] * 3])
    grey = np.dstack([mask.any(axis=2), np.ones((2, 3))])  # which cannot be seen through
    (inside,) = api.on_mask(grey)["approach_region"]["include"]
    np.testing.assert_array_equal(inside["mask"], [[False, True, False], [False, False, True]])
    assert "exclude" not in asked["contact_region"]


def test_an_object_is_cut_out_of_the_scene_that_repeats_it() -> None:
    scene = np.random.default_rng(0).uniform(-0.3, 0.3, (4000, 3))
    wanted = np.linalg.norm(scene - 0.1, axis=1) < 0.08
    for around in (np.concatenate([scene, [[np.nan] * 3]]), scene[~wanted]):
        cloud, segment_ids = api.object_in_scene(scene[wanted], around)
        np.testing.assert_array_equal(cloud[segment_ids == 1], scene[wanted].astype(np.float32))
        far = np.linalg.norm(cloud[segment_ids == 0] - 0.1, axis=1)
        assert far.min() > 0.07
        assert 0.97 * (~wanted).sum() < len(far) <= (~wanted).sum()


def test_answers_of_a_stream_are_those_of_single_requests(client, cloud) -> None:
    requests = [StreamRequest(cloud, seed=seed, top_k=3) for seed in range(6)]
    answers = list(client.detect_stream(requests))
    assert len(answers) == 6
    for seed, answer in enumerate(answers):
        assert answer.request_id == str(seed)
        alone = client.detect(cloud, seed=seed, top_k=3)
        assert_same(answer.result(), alone)
        assert answer.result().counts == alone.counts


def test_what_cannot_be_sent_is_an_error_and_the_stream_goes_on(client, cloud) -> None:
    clouds = [cloud, "nowhere.ply", cloud, cloud[:0]]
    first, missing, last, empty = client.detect_stream(
        [StreamRequest(each, request_id="a") for each in clouds]  # as who needs no names sends it
    )
    assert_same(first.result(), last.result())
    with pytest.raises(api.InvalidRequestError, match="cloud"):
        empty.result()
    with pytest.raises(api.InvalidRequestError, match="nowhere"):
        missing.result()
    with pytest.raises(api.InvalidRequestError, match="Give a cloud"):
        StreamRequest()


def test_requests_are_read_as_they_are_sent(client, cloud) -> None:
    """A controller's clouds have no end; leaving the answers ends the stream."""
    taken: list[int] = []

    def clouds() -> Iterator[StreamRequest]:
        for number in itertools.count():
            taken.append(number)
            yield StreamRequest(cloud)

    answers = client.detect_stream(clouds())
    assert [next(answers).request_id for _ in range(5)] == list("01234")
    answers.close()
    read = len(taken)
    assert client.detect(cloud).grasps
    assert len(taken) <= read + 1  # one may be under way


async def test_an_asynchronous_source(dummy_server, cloud, transport: str) -> None:
    names = [f"cloud {number}" for number in range(4)]

    async def clouds() -> AsyncIterator[StreamRequest]:
        for name in names:
            yield StreamRequest(cloud, request_id=name)

    async with AsyncGraspClient(dummy_server.address(transport)) as client:
        assert [answer.request_id async for answer in client.detect_stream(clouds())] == names


# What the tracker sends: the latest image, and what the last answer said.

UP = [0.0, 0.0, 1.0]


def answer(first: str = "kept", score: float = 0.9, grasps: int = 6) -> Detection:
    pose, place = np.eye(4, dtype=np.float32), np.zeros(3, np.float32)
    found = [
        api.Grasp(score, pose, pose, 0.08, place, place, place, True, 0.0, row // 5, None, row)
        for row in range(grasps)
    ]
    objects = [
        api.DetectedObject(n, 9, place, place, np.zeros(4, np.float32), None, 0.9, None, np.ones(6))
        for n in range(2)
    ]
    gripper, up = api.GripperOutline("panda", 0.06, 0.11), np.float32([0, 0, 1])
    tracking = api.Tracking(first, 20)
    return Detection(found, {}, {}, "m", gripper, [], None, None, up, objects, tracking)


def previous(tracker: GraspTracker) -> dict[str, Any]:
    return dict(tracker.options()["previous"])


def test_it_searches_first_then_follows_and_searches_again_after_some_images() -> None:
    tracker = GraspTracker(search_every=3, at=(3, 4))
    assert previous(tracker) == {"next_id": 0, "search": True, "objects": []}
    tracker.take(answer(grasps=0))
    assert [one["number"] for one in previous(tracker)["objects"]] == [0, 1]
    searched = []
    for _ in range(6):
        tracker.take(answer())
        sent = previous(tracker)
        searched.append(sent["search"])
        assert [grasp["id"] for grasp in sent["grasps"]] == [0, 1, 2, 3]
        assert [one["number"] for one in sent["objects"]] == ([0, 1] if sent["search"] else [0])
        assert sent["next_id"] == 20
    assert searched == [False, False, True] * 2
    assert tracker.options()["at"] is None


def test_the_followed_object_is_sent_of_more_than_a_request_may_name() -> None:
    tracker, found = GraspTracker(search_every=1), answer()
    many = [replace(found.objects[0], number=number) for number in range(70)]
    grasps = [replace(one, object=69) for one in found.grasps]
    tracker.take(replace(found, objects=many, grasps=grasps))
    assert [one["number"] for one in previous(tracker)["objects"]] == [69, *range(63)]


@pytest.mark.parametrize("asked", ["auto", {"kind": "ransac"}, None, {"normal": UP, "offset": 0}])
def test_a_support_that_is_looked_for_is_the_last_answers_while_it_follows(asked: Any) -> None:
    tracker = GraspTracker(support=asked)
    tracker.take(replace(answer(), support=FoundSupport(np.float32(UP), 0.5, None, 1.0)))
    found = asked == "auto" or asked == {"kind": "ransac"}
    assert tracker.options()["support"] == ({"normal": UP, "offset": 0.5} if found else asked)


@pytest.mark.parametrize("bad", [answer("lost"), answer(grasps=0), answer(score=0.4)])
def test_after_a_bad_answer_it_looks_for_others_too(bad: Detection) -> None:
    tracker = GraspTracker()
    tracker.options()
    tracker.take(answer("started", score=0.9))
    for _ in range(2):  # the first score without a search, which may be lower, is the one to keep
        assert not previous(tracker)["search"]
        tracker.take(answer(score=0.6))
    tracker.options()
    tracker.take(bad)
    sent = previous(tracker)
    assert sent["search"]
    assert sent["grasps"][0]["id"] == 0  # the one to keep if it is there after all


def test_a_hollow_object_is_looked_for_where_it_was_grasped() -> None:
    wall, pose = np.float32([0.1, 0.0, 0.0]), np.eye(4)
    ring = SimpleNamespace(number=1, surface=wall, confidence=None, center=np.zeros(3))
    grasp = SimpleNamespace(id=0, object=1, score=0.9, T_cloud_hand=pose, contact_point=wall)
    plain = {"support": None, "up": None, "gripper": SimpleNamespace(name="panda")}
    tracking = SimpleNamespace(next_id=1, first="started")
    found: Any = SimpleNamespace(grasps=[grasp], objects=[ring], tracking=tracking, **plain)
    tracker = GraspTracker(near=(0.1, 0.0, 0.0))
    tracker.options()
    tracker.take(found)
    np.testing.assert_array_equal(tracker.options()["near"], wall)


def test_images_that_come_while_one_is_at_work_are_dropped_but_for_the_latest() -> None:
    """And an error of the camera is raised."""
    read, seen = threading.Event(), []

    def detect(**_: Any) -> Detection:
        read.wait()
        return answer("started")

    def camera() -> Iterator[dict[str, Any]]:
        for number in range(10):
            yield {"cloud": np.full((5, 3), number, np.float32)}
        read.set()
        raise OSError("unplugged")

    client: Any = SimpleNamespace(detect=detect)
    with pytest.raises(OSError, match="unplugged"):
        seen.extend(image["cloud"][0, 0] for image, _ in GraspTracker().follow(client, camera()))
    assert seen[-1] == 9
    assert len(seen) <= 2


def test_a_source_that_exits_ends_the_loop(client) -> None:
    def camera() -> Iterator[Any]:
        sys.exit("no camera")
        yield

    def read(results: Iterator[Any]) -> None:
        with pytest.raises((SystemExit, api.GraspClientError), match="no camera"):
            list(results)
        ended.append(True)

    ended: list[bool] = []
    for results in (client.detect_stream(camera()), GraspTracker().follow(client, camera())):
        reader = threading.Thread(target=read, args=(results,), daemon=True)
        reader.start()
        reader.join(60)
    assert ended == [True, True]
    assert client.ready()
