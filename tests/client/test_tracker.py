"""What the tracker sends: the latest image, and what the last answer said."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from edgegrasp_client import (
    DetectedObject,
    Detection,
    Grasp,
    GraspTracker,
    GripperOutline,
    StreamAnswer,
    Tracking,
)
from edgegrasp_results import FoundSupport

UP = [0.0, 0.0, 1.0]
CLOUD = np.zeros((5, 3), np.float32)


def answer(first: str = "kept", score: float = 0.9, grasps: int = 6) -> Detection:
    pose, place = np.eye(4, dtype=np.float32), np.zeros(3, np.float32)
    found = [
        Grasp(score, pose, pose, 0.08, place, place, place, True, 0.0, row // 5, None, row)
        for row in range(grasps)
    ]
    objects = [
        DetectedObject(n, 9, place, place, np.zeros(4, np.float32), None, 0.9, None, np.ones(6))
        for n in range(2)
    ]
    gripper, up = GripperOutline("panda", 0.06, 0.11), np.float32([0, 0, 1])
    tracking = Tracking(first, 20)
    return Detection(found, {}, {}, "m", gripper, [], None, None, up, objects, tracking)


def previous(tracker: GraspTracker) -> dict[str, Any]:
    return dict(tracker.options()["previous"])


def test_it_searches_first_then_follows_and_searches_again_after_some_images() -> None:
    tracker = GraspTracker(search_every=3, at=(3, 4))
    assert previous(tracker) == {"next_id": 0, "search": True}
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
    tracker.take(answer("started"))
    assert not previous(tracker)["search"]
    tracker.take(bad)
    sent = previous(tracker)
    assert sent["search"]
    assert sent["grasps"][0]["id"] == 0  # the one to keep if it is there after all


def followed(camera: Iterator[Any], at_work: Callable[[], Any] = bool) -> list[Any]:
    """The images that a tracker sends to a server, which calls `at_work` for each."""

    def stream(requests: Any) -> Iterator[StreamAnswer]:
        for _ in requests:
            at_work()
            yield StreamAnswer("", answer("started"))

    client: Any = SimpleNamespace(detect_stream=stream)
    return [image["cloud"][0, 0] for image, _ in GraspTracker().follow(client, camera)]


def test_images_that_come_while_one_is_at_work_are_dropped_but_for_the_latest() -> None:
    read = threading.Event()

    def camera() -> Iterator[dict[str, Any]]:
        for number in range(10):
            yield {"cloud": CLOUD + number}
        read.set()

    seen = followed(camera(), read.wait)
    assert seen[-1] == 9
    assert len(seen) <= 2


def test_an_error_of_the_camera_is_raised() -> None:
    def camera() -> Iterator[dict[str, Any]]:
        yield {"cloud": CLOUD}
        raise OSError("unplugged")

    with pytest.raises(OSError, match="unplugged"):
        followed(camera())
