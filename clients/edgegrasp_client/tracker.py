"""Follow grasps through the images of a camera."""

import queue
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, cast

from typing_extensions import Unpack

from edgegrasp_client.client import GraspClient
from edgegrasp_client.options import DetectOptions, Previous
from edgegrasp_results import DetectedObject, Detection

GRASPS_PER_OBJECT = 4  # grasps on one object, of which the first is the one to keep
MAX_OBJECTS = 64  # objects that a request may name
SEARCHED_SUPPORTS = ("auto", "ransac")  # kinds of support that are looked for
MIN_SCORE_SHARE = 0.7  # share of a grasp's first score, below which others are looked for


class GraspTracker:
    """Sends with each image what the last answer said, so that the answer follows it.

    Most answers only move the grasps along with their object, in a fraction of the time; now and
    then, and where the score drops or the grasp is lost, others are looked for too.

    Args:
        search_every: Images after which others are looked for.
        **options: Those of `GraspClient.detect`; the tracker sets `previous`.
    """

    def __init__(self, search_every: int = 30, **options: Unpack[DetectOptions]) -> None:
        self._options: dict[str, Any] = dict(options)
        self._every = search_every
        self._last: Detection | None = None  # with a grasp
        self._objects: dict[int, DetectedObject] = {}
        self._next_id = 0
        self._since = 0  # images since others were looked for
        self._score = 0.0  # of the first grasp then
        self._searching = True  # in the request that is to be answered
        self._reader: threading.Thread | None = None  # of `_images`
        self._images: object = None

    def follow(
        self, client: GraspClient, images: Iterable[Mapping[str, Any]]
    ) -> Iterator[tuple[Mapping[str, Any], Detection]]:
        """Find grasps in one image after the other.

        `images` are what `GraspClient.detect` gets, such as {"depth_images": [image]}. Of those
        that come while one is at work, only the latest is sent.

        Yields:
            An image and its answer. Raises GraspClientError, and whatever `images` raises.
        """
        latest: queue.Queue[Any] = queue.Queue(1)
        stopped = threading.Event()
        if self._reader is not None and images is self._images:  # it may still wait for one
            self._reader.join()
        self._images = images
        self._reader = threading.Thread(target=_read, args=(images, latest, stopped), daemon=True)
        self._reader.start()
        try:
            while (image := latest.get()) is not None:
                if isinstance(image, Exception):
                    raise image
                detection = client.detect(**{**image, **self.options()})
                self.take(detection)
                yield image, detection
        finally:
            stopped.set()
            with suppress(queue.Empty):  # the end of the images waits for its place
                latest.get_nowait()

    def options(self) -> DetectOptions:
        """The options of the next request."""
        last, options = self._last, dict(self._options)
        self._searching = last is None or self._since >= self._every
        object_ = last and last.grasps[0].object
        previous: dict[str, Any] = {"next_id": self._next_id, "search": self._searching}
        previous["objects"] = [
            {"number": one.number, "surface": one.surface, "confidence": one.confidence}
            for one in sorted(self._objects.values(), key=lambda one: one.number != object_)
            if self._searching or one.number == object_
        ][:MAX_OBJECTS]
        if last is not None:
            grasps = [grasp for grasp in last.grasps if grasp.object == object_][:GRASPS_PER_OBJECT]
            previous["gripper"] = last.gripper.name
            previous["grasps"] = [
                {"id": one.id, "T_cloud_hand": one.T_cloud_hand.ravel(), "object": one.object}
                for one in grasps
            ]
            if not self._searching:
                seen = last.support
                plane = seen and {"normal": seen.normal.tolist(), "offset": seen.offset}
                asked = options.get("support", "auto")
                kind = asked.get("kind") if isinstance(asked, Mapping) else asked
                options |= {"support": plane if kind in SEARCHED_SUPPORTS else asked, "up": last.up}
            if options.keys() & {"at", "near"} and object_ in self._objects:
                options |= {"at": None, "near": self._objects[object_].center}
        return cast("DetectOptions", options | {"previous": cast("Previous", previous)})

    def take(self, detection: Detection) -> None:
        """Remember an answer to a request with `options()`."""
        tracking = detection.tracking
        assert tracking is not None
        self._next_id = tracking.next_id
        self._since += 1
        if not self._searching and (tracking.first == "lost" or not detection.grasps):
            self._since = self._every  # perhaps a bad image: look once more for the same grasp
            return
        if self._searching:
            self._objects, self._since, self._last = {}, 1, None
        self._objects |= {one.number: one for one in detection.objects if one.surface is not None}
        if detection.grasps:
            self._last, score = detection, detection.grasps[0].score
            self._score = score if self._searching else self._score
            if score < MIN_SCORE_SHARE * self._score:
                self._since = self._every


def _read(images: Iterable[Any], latest: "queue.Queue[Any]", stopped: threading.Event) -> None:
    """Keep the latest image in a queue of one; then None, or the error that there was."""
    end = None
    try:
        for image in images:
            if stopped.is_set():
                return
            with suppress(queue.Empty):
                latest.get_nowait()
            latest.put(image)
    except Exception as error:
        end = error
    while not stopped.is_set():  # once the last image is taken
        with suppress(queue.Full):
            return latest.put(end, timeout=0.1)
