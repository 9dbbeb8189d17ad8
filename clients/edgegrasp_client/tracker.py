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

GRASPS_PER_OBJECT = 4  # grasps sent for the followed object; the first is the grasp to keep
MAX_OBJECTS = 64  # objects that a request may name
SEARCHED_SUPPORTS = ("auto", "ransac")  # kinds of support that the detector searches for
MIN_SCORE_SHARE = 0.7  # search for other grasps below this share of the first score


class GraspTracker:
    """Sends parts of the last answer with each image, so that the new answer follows them.

    Most answers only move the grasps along with their object, in a fraction of the time. At
    intervals, and if the score drops or the grasp is lost, other grasps are searched for too.

    Args:
        search_every: Number of images between two searches for other grasps.
        **options: Options of `GraspClient.detect`; the tracker sets `previous`.
    """

    def __init__(self, search_every: int = 30, **options: Unpack[DetectOptions]) -> None:
        self._options: dict[str, Any] = dict(options)
        self._every = search_every
        self._last: Detection | None = None  # the last answer that has a grasp
        self._objects: dict[int, DetectedObject] = {}
        self._next_id = 0
        self._since = 0  # images since the last search
        self._score = 0.0  # of the first grasp in the first image after the last search
        self._searching = True  # whether the current request searches
        self._reader: threading.Thread | None = None  # of `_images`
        self._images: object = None

    def follow(
        self, client: GraspClient, images: Iterable[Mapping[str, Any]]
    ) -> Iterator[tuple[Mapping[str, Any], Detection]]:
        """Find grasps in one image after another.

        `images` are arguments of `GraspClient.detect`, such as {"depth_images": [image]}. Of the
        images that arrive while one is being processed, only the latest is sent.

        Yields:
            An image and its answer. Raises GraspClientError, and any error that `images` raises.
        """
        latest: queue.Queue[Any] = queue.Queue(1)
        stopped = threading.Event()
        if self._reader is not None and images is self._images:  # it may still wait for an image
            self._reader.join()
        self._images = images
        self._reader = threading.Thread(target=_read, args=(images, latest, stopped), daemon=True)
        self._reader.start()
        try:
            while (image := latest.get()) is not None:
                if isinstance(image, BaseException):
                    raise image
                detection = client.detect(**{**image, **self.options()})
                self.take(detection)
                yield image, detection
        finally:
            stopped.set()
            with suppress(queue.Empty):  # make room for the end of the images
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
            if options.keys() & {"at", "near"}:
                options |= {"at": None, "near": last.grasps[0].contact_point}
        return cast("DetectOptions", options | {"previous": cast("Previous", previous)})

    def take(self, detection: Detection) -> None:
        """Remember an answer to a request with `options()`."""
        tracking = detection.tracking
        assert tracking is not None
        self._next_id = tracking.next_id
        self._since += 1
        if not self._searching and (tracking.first == "lost" or not detection.grasps):
            self._since = self._every  # perhaps a bad image: search for the same grasp once more
            return
        if self._searching:
            self._objects, self._since, self._last = {}, 1, None
        self._objects |= {one.number: one for one in detection.objects if one.surface is not None}
        if detection.grasps:
            self._last, score = detection, detection.grasps[0].score
            self._score = 0.0 if self._searching else self._score or score
            if score < MIN_SCORE_SHARE * self._score:
                self._since = self._every


def _read(images: Iterable[Any], latest: "queue.Queue[Any]", stopped: threading.Event) -> None:
    """Keep the latest image in a queue of one; at the end put None, or the error of the images."""
    end: BaseException | None = None
    try:
        for image in images:
            if stopped.is_set():
                return
            with suppress(queue.Empty):
                latest.get_nowait()
            latest.put(image)
    except BaseException as error:
        end = error
    while not stopped.is_set():  # once the last image is taken
        with suppress(queue.Full):
            return latest.put(end, timeout=0.1)
