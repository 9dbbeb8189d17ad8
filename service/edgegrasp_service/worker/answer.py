"""Answer requests in a worker process, one at a time: decode, detect, encode.

Every fault of a request is returned as a Problem. This module knows no event loops, connections or
transports.
"""

import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson

from edgegrasp_camera.arrays import Array
from edgegrasp_model.errors import EdgeGraspError, InvalidRequest, parse
from edgegrasp_model.options import DetectOptions, parse_options
from edgegrasp_model.request_cloud import GIVEN, decode_array, decode_cloud
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_results import Detection
from edgegrasp_service import recording
from edgegrasp_service.errors import DeadlineExceeded, PayloadTooLarge, UnsupportedMediaType, report
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker import bodies
from edgegrasp_service.worker.process import Answer, Facts, Job, limited_memory

if TYPE_CHECKING:
    from edgegrasp_model.detector import ModelCatalogue
    from edgegrasp_robot import Robot

# Memory for reading a request: numbers take about 12 times as much in Python as in JSON.
DECODE_BYTES, DECODE_FACTOR = 512 * 2**20, 24
ENCODE_SHARE = 0.1  # share of a request's time that is kept for writing its answer


def load_catalogue(settings: Settings) -> "ModelCatalogue":
    """Load the detectors of the settings and warm them up; raises EdgeGraspError for a bad file."""
    # Torch takes seconds to import, and some tests do without it.
    from edgegrasp_model.detector import ModelCatalogue, choose_device

    device = choose_device(settings.device)
    catalogue = ModelCatalogue.load(
        settings.weights, settings.default_model, device, settings.grippers
    )
    catalogue.warm_up()
    load_robots(settings)
    return catalogue


def load_robots(settings: Settings) -> "Mapping[str, Robot]":
    """The robots that the settings name; loaded once, before the workers fork."""
    if not settings.robots:
        return {}
    import edgegrasp_robot  # imports half a gigabyte, which few servers need

    return edgegrasp_robot.load_robots(settings.robots)


def answer(job: Job, catalogue: "ModelCatalogue", settings: Settings) -> Answer:
    """Decode a job, detect, and encode the answer; nothing is kept for the next job.

    A cloud that would exceed its deadline, at the pace measured when the catalogue was loaded, is
    refused before any work.

    Returns:
        The answer, or an empty one with its Problem if the request cannot be answered.

    Raises:
        MemoryError: Out of memory; the process should be replaced.
    """
    work = _Work(job, catalogue, settings, time.monotonic() + job.remaining)
    try:
        return Answer(work.answer(), work.facts)
    except EdgeGraspError as error:
        problem = report(error)
    except Exception as error:
        # PyTorch raises an error of its own for each kind of device.
        torch_error = type(error).__name__ == "OutOfMemoryError"
        if isinstance(error, MemoryError) or torch_error or "can't allocate memory" in str(error):
            raise MemoryError(str(error)) from None
        problem = report(error)
        work.facts.traceback = traceback.format_exc()
        if work.options is not None:  # rows in it may be millions
            work.facts.options = work.options.model_dump_json(exclude_defaults=True)[:2000]
    return Answer(b"", work.facts, problem)


@dataclass
class _Work:
    """One job while it is being answered."""

    job: Job
    catalogue: "ModelCatalogue"
    settings: Settings
    deadline: float  # by time.monotonic
    facts: Facts = field(default_factory=Facts)
    options: DetectOptions | None = None  # known once they are parsed

    def answer(self) -> bytes:
        """The body of the answer; may raise any error."""
        if self.job.method == "Beat":
            return b"{}"
        if self.job.method == "RecordOutcome":
            self._record_outcome()
            return b"{}"
        with self._stage("decode"):
            detector, cloud, options, given = self._decode()
        result: Any
        if self.job.method == "DetectGrasps":
            result = self._detect(detector, cloud, options)
            self.facts.grasps = len(result.grasps)
        else:
            if options.robot is not None:
                fix = "Leave it out, or detect: reach is planned for detected grasps."
                raise InvalidRequest("options.robot", "a robot beside given grasps", fix)
            with self._stage("score"):
                most = self.settings.max_voxels
                result = detector.score(cloud, options, **given, max_voxels=most)
            self.facts.grasps = len(result.evaluations)
        self.facts.model = result.model
        self.facts.counts = dict(result.counts)
        with self._stage("encode"):
            body = bodies.write(self.job.transport, result)
        return body

    def _record_outcome(self) -> None:
        """Append a tried grasp, the digest of its weights and the time to the outcomes' file."""
        kind, path = self.job.content_type, self.settings.outcomes_file
        if not kind.lower().startswith(bodies.JSON):  # foreign web pages cannot send it
            fix = f"Send {bodies.JSON}."
            raise UnsupportedMediaType("Content-Type", repr(kind[:40]), fix)
        if path is None:  # Ray has this path without the setting too
            raise InvalidRequest("path", "/v1/outcomes", "Set the setting `outcomes_file`.")
        fields = bodies.read_json("body", self.job.body)
        tried = parse(recording.TriedGrasp, fields, "body")
        self.catalogue.get(tried.model)  # raises UnknownModel
        digests = {row["name"]: row["digest"] for row in self.catalogue.describe()}
        line = tried.model_dump() | {"digest": digests[tried.model]}
        line["time"] = datetime.now(UTC).isoformat()
        recording.append_line(path, orjson.dumps(line) + b"\n")

    def _detect(self, detector: Any, cloud: CloudInput, options: DetectOptions) -> Detection:
        """Detect, and plan an arm's motions where the request names a robot."""
        asked, robot = options, None
        if asked.robot is not None:
            robots, name = load_robots(self.settings), asked.robot.name
            if name not in robots:
                fix = f"Use one of: {', '.join(robots)}." if robots else "Set the setting `robots`."
                raise InvalidRequest("options.robot.name", repr(name), fix)
            from edgegrasp_robot import plan_picks, with_robot

            robot = robots[name]
            options = with_robot(options, robot)
        with self._stage("prepare"):
            most = self._within_deadline(self.settings.max_voxels, self.catalogue.pace.voxel)
            prepared = detector.prepare(cloud, options, most)
            self.facts.counts = dict(prepared.counts)
        with self._stage("network"):
            logits = detector.evaluate(prepared)
        with self._stage("finish"):
            detection: Detection = detector.finish(prepared, logits)
        if robot is not None:
            until = self.deadline - ENCODE_SHARE * self.job.remaining
            with self._stage("arm"):
                detection = plan_picks(detection, prepared.scene, cloud.points, asked, robot, until)
        return detection

    def _decode(self) -> tuple[Any, CloudInput, DetectOptions, dict[str, Array]]:
        """Decode a request within the limits: detector, cloud, options, given grasps."""
        size, most = len(self.job.body), self.settings.max_points
        in_time = most
        try:
            with limited_memory(DECODE_BYTES + DECODE_FACTOR * size):
                fields = bodies.read_request(self.job)
                self.options = options = parse_options(fields["options"])
                detector = self.catalogue.get(options.model)
                given = {} if self.job.method == "DetectGrasps" else _given(fields, most)
                in_time = self._within_deadline(most, self.catalogue.pace.point)
                cloud, options = decode_cloud(fields, options, in_time)
        except MemoryError:
            value, fix = f"{size} bytes that take too much memory to read", "Send packed arrays."
            raise PayloadTooLarge("body", value, fix) from None
        except PayloadTooLarge as error:
            if in_time == most:
                raise
            why = f"{error.value} take longer than the deadline allows. Send fewer, or allow more."
            raise DeadlineExceeded(f"{error.field}: {why}") from None
        points = cloud.points
        self.facts.points = points.size // 3 if isinstance(points, np.ndarray) else 0
        return detector, cloud, options, given

    def _within_deadline(self, most: int, seconds: float) -> int:
        """The number of points or voxels, at most `most`, that can be processed in time."""
        remaining = max(self.deadline - time.monotonic(), 0.0)
        return int(min(most, remaining / seconds)) if seconds else most

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        """Time a stage; raises DeadlineExceeded instead of starting it too late."""
        start = time.monotonic()
        if start > self.deadline:
            raise DeadlineExceeded()
        try:
            yield
        finally:
            self.facts.seconds[name] = time.monotonic() - start


def _given(fields: Mapping[str, Any], max_points: int) -> dict[str, Array]:
    """The edges or hand poses to score; raises InvalidRequest unless there is one of the two."""
    names = [name for name in GIVEN if fields.get(name) is not None]
    if not names:
        raise InvalidRequest("edges", "nothing", "Send edges or hand_poses.")
    if len(names) == 2:
        raise InvalidRequest("hand_poses", "poses beside edges", "Send one of the two.")
    name, given = names[0], fields[names[0]]
    if not isinstance(given, np.ndarray):
        given = decode_array(name, given, max_points)
    return {name: given}
