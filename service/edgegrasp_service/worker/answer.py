"""Answer requests in a worker process, one at a time: decode, detect, encode.

Over HTTP a request is JSON, a point cloud file, or a form with parts, and an answer is JSON. A gRPC
message is converted to the fields of the same request in JSON, so that one schema checks both.
Every error of a request is returned as a Problem. This module is independent of event loops,
connections and transports.
"""

import io
import json
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, is_dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import PurePath
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

import numpy as np
import orjson
from google.protobuf.message import DecodeError, Message
from google.protobuf.unknown_fields import UnknownFieldSet
from werkzeug.exceptions import HTTPException, RequestEntityTooLarge
from werkzeug.formparser import MultiPartParser
from werkzeug.http import parse_options_header

from edgegrasp.v1 import grasp_pb2
from edgegrasp_camera.arrays import Array
from edgegrasp_camera.files import FILE_FORMATS
from edgegrasp_model.errors import EdgeGraspError, InvalidRequest, brief, parse
from edgegrasp_model.options import MAX_CANDIDATES, MAX_ROWS, DetectOptions, parse_options
from edgegrasp_model.request_cloud import (
    CAMERA,
    GIVEN,
    PER_POINT,
    File,
    decode_array,
    decode_cloud,
    options_of_texts,
    unique_keys,
    value_of_text,
)
from edgegrasp_model.scene.cloud import CloudInput
from edgegrasp_results import Detection, Scoring, plain
from edgegrasp_service import errors
from edgegrasp_service.settings import Settings
from edgegrasp_service.worker import recording
from edgegrasp_service.worker.process import Answer, Facts, Job, Transport, limited_memory

if TYPE_CHECKING:
    from edgegrasp_model.detector import ModelCatalogue
    from edgegrasp_robot import Robot

# Memory for reading a request: numbers take about 12 times as much in Python as in JSON.
DECODE_BYTES, DECODE_FACTOR = 512 * 2**20, 24
ENCODE_SHARE = 0.1  # share of a request's time that is kept for writing its answer

JSON, FORM = "application/json", "multipart/form-data"
FILE_TYPES = {f"application/x-{name}": name for name in FILE_FORMATS}
PART_TYPES = FILE_TYPES | {"image/png": "png"}
FIELDS = ("point_cloud2", "depth_images", *PER_POINT, "options")
MAX_QUERY_FIELDS = 64
MAX_CAMERA_TEXT = 1000  # most bytes of a part like 615,615,320,240; a longer one must be JSON
MAX_SHORT_LISTS = 20_000  # in JSON; edges take 6 bytes each

MAX_PARTS = 64  # most messages in a repeated field; no option takes more


def load_catalogue(settings: Settings) -> "ModelCatalogue":
    """Load the detectors of the settings and warm them up; raises EdgeGraspError for a bad file."""
    # Torch takes seconds to import, and some tests do without it.
    from edgegrasp_model.detector import ModelCatalogue, choose_device

    catalogue = ModelCatalogue.load(
        settings.weights, settings.default_model, choose_device(settings.device), settings.grippers
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

    A cloud that would exceed its deadline, at the costs measured when the catalogue was loaded, is
    refused before any work.

    Returns:
        The answer, or an empty one with its Problem if the request cannot be answered.

    Raises:
        MemoryError: Out of memory; the process should be replaced.
    """
    work = _RunningJob(job, catalogue, settings, time.monotonic() + job.remaining)
    facts = work.facts
    try:
        if job.method == "RecordOutcome":
            work.record_outcome()
        if job.method in ("Beat", "RecordOutcome"):
            return Answer(b"{}", facts)
        with work.stage("decode"):
            detector, cloud, options, given = work.decode()
        result: Any
        if job.method == "DetectGrasps":
            result = work.detect(detector, cloud, options)
            facts.grasps = len(result.grasps)
        else:
            with work.stage("score"):
                result = detector.score(cloud, options, **given, max_voxels=settings.max_voxels)
            facts.grasps = len(result.evaluations)
        facts.model, facts.counts = result.model, dict(result.counts)
        with work.stage("encode"):
            body = serialize_result(job.transport, result)
        return Answer(body, facts)
    except EdgeGraspError as error:
        problem = errors.to_problem(error)
    except Exception as error:
        # PyTorch raises an error of its own for each kind of device.
        torch_error = type(error).__name__ == "OutOfMemoryError"
        if isinstance(error, MemoryError) or torch_error or "can't allocate memory" in str(error):
            raise MemoryError(str(error)) from None
        problem = errors.to_problem(error)
        facts.traceback = traceback.format_exc()
        if work.options is not None:  # its lists may have millions of rows
            facts.options = work.options.model_dump_json(exclude_defaults=True)[:2000]
    return Answer(b"", facts, problem)


@dataclass
class _RunningJob:
    """One job while it is being answered."""

    job: Job
    catalogue: "ModelCatalogue"
    settings: Settings
    deadline: float  # by time.monotonic
    facts: Facts = field(default_factory=Facts)
    options: DetectOptions | None = None  # known once they are parsed

    def record_outcome(self) -> None:
        """Append a tried grasp, the digest of its weights and the time to the outcomes file."""
        kind, path = self.job.content_type, self.settings.outcomes_file
        if not kind.lower().startswith(JSON):  # foreign web pages cannot send it
            raise errors.UnsupportedMediaType("Content-Type", repr(kind[:40]), f"Send {JSON}.")
        if path is None:
            raise InvalidRequest("path", "/v1/outcomes", "Set the setting `outcomes_file`.")
        tried = parse(recording.TriedGrasp, read_json("body", self.job.body), "body")
        self.catalogue.get(tried.model)  # raises UnknownModel
        digests = {row["name"]: row["digest"] for row in self.catalogue.describe()}
        line = tried.model_dump() | {"digest": digests[tried.model]}
        line["time"] = datetime.now(UTC).isoformat()
        recording.append_line(path, orjson.dumps(line) + b"\n")

    def detect(self, detector: Any, cloud: CloudInput, options: DetectOptions) -> Detection:
        """Detect, and plan the arm's motions if the request names a robot."""
        asked, robot = options, None
        if asked.robot is not None:
            robots, name = load_robots(self.settings), asked.robot.name
            if name not in robots:
                fix = f"Use one of: {', '.join(robots)}." if robots else "Set the setting `robots`."
                raise InvalidRequest("options.robot.name", repr(name), fix)
            from edgegrasp_robot import options_for_robot, plan_picks

            robot = robots[name]
            options = options_for_robot(options, robot)
        with self.stage("prepare"):
            most = self._within_deadline(self.settings.max_voxels, self.catalogue.unit_costs.voxel)
            prepared = detector.prepare(cloud, options, most)
            self.facts.counts = dict(prepared.counts)
        with self.stage("network"):
            logits = detector.evaluate(prepared)
        with self.stage("finish"):
            detection: Detection = detector.finish(prepared, logits)
        if robot is not None:
            until = self.deadline - ENCODE_SHARE * self.job.remaining
            with self.stage("arm"):
                detection = plan_picks(detection, prepared.scene, asked, robot, until)
        return detection

    def decode(self) -> tuple[Any, CloudInput, DetectOptions, dict[str, Array]]:
        """Decode a request within the limits: detector, cloud, options, given grasps."""
        size, most = len(self.job.body), self.settings.max_points
        in_time = most
        try:
            with limited_memory(DECODE_BYTES + DECODE_FACTOR * size):
                fields = read_request(self.job)
                self.options = options = parse_options(fields["options"])
                detector = self.catalogue.get(options.model)
                given = _given(fields, options, most) if self.job.method == "ScoreGrasps" else {}
                in_time = self._within_deadline(most, self.catalogue.unit_costs.point)
                cloud = decode_cloud(fields, options, in_time)
        except MemoryError:
            value, fix = f"{size} bytes that take too much memory to read", "Send packed arrays."
            raise errors.PayloadTooLarge("body", value, fix) from None
        except errors.PayloadTooLarge as error:
            if in_time == most:
                raise
            why = f"{error.value} take longer than the deadline allows. Send fewer, or allow more."
            raise errors.DeadlineExceeded(f"{error.field}: {why}") from None
        self.facts.points = np.asarray(cloud.points).size // 3
        return detector, cloud, options, given

    def _within_deadline(self, most: int, seconds: float) -> int:
        """The number of points or voxels, at most `most`, that can be processed in time."""
        remaining = max(self.deadline - time.monotonic(), 0.0)
        return int(min(most, remaining / seconds)) if seconds else most

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; raises DeadlineExceeded instead of starting it too late."""
        start = time.monotonic()
        if start > self.deadline:
            raise errors.DeadlineExceeded()
        try:
            yield
        finally:
            self.facts.seconds[name] = time.monotonic() - start


def _given(fields: Mapping[str, Any], options: DetectOptions, max_points: int) -> dict[str, Array]:
    """The edges or hand poses to score; raises InvalidRequest unless there is one of the two."""
    if options.robot is not None:
        fix = "Leave it out, or detect: reach is planned for detected grasps."
        raise InvalidRequest("options.robot", "a robot with given grasps", fix)
    names = [name for name in GIVEN if fields.get(name) is not None]
    if not names:
        raise InvalidRequest("edges", "nothing", "Send edges or hand_poses.")
    if len(names) == 2:
        raise InvalidRequest("hand_poses", "poses and edges", "Send one of the two.")
    (name,) = names
    return {name: decode_array(name, fields[name], max_points)}


# Bodies


def read_request(job: Job) -> dict[str, Any]:
    """The fields of a request.

    Returns:
        The fields that were sent, and `options`. A value is plain JSON, or a File (always for
        `cloud`), or bytes or an array from a message.

    Raises:
        InvalidRequest: The body does not match its content type, has unknown fields or parts, or
            comes with query parameters although it has options; or a message is invalid.
        UnsupportedMediaType: There is no reader for the content type.
    """
    if job.transport == "grpc":
        return _fields_of_message(job)
    media_type, named = parse_options_header(job.content_type)
    media_type = media_type.lower()
    scores = job.method == "ScoreGrasps"
    accepted = (JSON, FORM) if scores else (JSON, *FILE_TYPES, FORM)
    if media_type not in accepted:
        fix = f"Send one of: {', '.join(accepted)}."
        raise errors.UnsupportedMediaType("Content-Type", repr(media_type), fix)
    try:
        parameters = parse_qsl(job.query, True, max_num_fields=MAX_QUERY_FIELDS)
    except ValueError:
        value = f"more than {MAX_QUERY_FIELDS} parameters"
        raise InvalidRequest("query", value, "Send each option once.") from None
    if media_type in FILE_TYPES:
        file = File(FILE_TYPES[media_type], job.body)
        return {"cloud": file, "options": options_of_texts(parameters)}
    if parameters:
        fix = "Send options in the body: a JSON body's `options`, or a form's part `options`."
        raise InvalidRequest(parameters[0][0], "a query parameter", fix)
    known = ("points" if media_type == JSON else "cloud", *FIELDS, *(GIVEN if scores else ()))
    if media_type == JSON:
        fields: dict[str, Any] = read_json("body", job.body)
        if not isinstance(fields, dict):
            raise InvalidRequest("body", brief(fields), "Send a JSON object.")
        for name in fields:
            if name not in known:
                raise _unknown(name, known, "field")
    else:
        fields = _fields_of_form(job.body, named.get("boundary", ""), (*known, *CAMERA))
    if not isinstance(fields.setdefault("options", {}), dict):
        raise InvalidRequest("options", brief(fields["options"]), "Send a JSON object.")
    return fields


def serialize_result(transport: Transport, result: Detection | Scoring) -> bytes:
    """Serialize a result as DetectionBody or ScoringBody, with exact float32, or as a message."""
    if transport == "http":
        return orjson.dumps(result, default=plain, option=orjson.OPT_PASSTHROUGH_DATACLASS)
    if isinstance(result, Detection):
        return grasp_pb2.DetectGraspsResponse(**_flat(result)).SerializeToString()
    return grasp_pb2.ScoreGraspsResponse(**_flat(result)).SerializeToString()


def _flat(value: Any) -> Any:
    """Fields in the form of messages: arrays flat, in row-major order."""
    if isinstance(value, np.ndarray):
        return value.ravel().tolist()
    if isinstance(value, list):
        return [_flat(part) for part in value]
    if is_dataclass(value):
        return {name: _flat(part) for name, part in vars(value).items()}
    return value


def _unknown(name: str, known: tuple[str, ...], kind: str) -> InvalidRequest:
    *names, last = known
    fix = f"Send {', '.join(names)} and {last} only."
    if name in DetectOptions.model_fields:
        fix = "Send it in `options`."
    return InvalidRequest(name, f"an unknown {kind}", fix)


# JSON


def read_json(field: str, text: bytes) -> Any:
    """Parse JSON within the memory allowed for a request of its size.

    Raises:
        InvalidRequest: It is not JSON, has a key twice, or would take far more memory than points
            of its size.
    """
    lists = text.count(b"[") + text.count(b"{")
    # Most lists are points of 8 bytes or more; an empty list takes 3 bytes, but 64 in memory.
    if lists > len(text) // 7 + MAX_SHORT_LISTS:
        value = f"{lists} lists and objects in {len(text)} bytes"
        raise InvalidRequest(field, value, "Send lists that hold numbers.")
    try:
        return json.loads(text, object_pairs_hook=partial(unique_keys, field))
    except (ValueError, RecursionError) as error:
        is_array = field in ("depth", *PER_POINT)  # perhaps an image of another format
        fix = "Send an .npy or .png file, or JSON." if is_array else "Send a JSON object."
        why = str(error).partition(";")[0]  # the rest is advice for programmers of Python
        raise InvalidRequest(field, f"invalid JSON ({why})", fix) from None


# Forms


def _fields_of_form(body: bytes, boundary: str, known: tuple[str, ...]) -> dict[str, Any]:
    """Files as File, other parts as their JSON; the parts of one camera as `depth_images`."""
    fields: dict[str, Any] = {}
    for name, file_format, data in _parts(body, boundary, len(known) + 1):
        if name not in known:
            raise _unknown(name, known, "part")
        if name in fields:
            raise InvalidRequest(name, "two parts", "Send one.")
        if name == "cloud" and file_format is None:
            raise InvalidRequest("cloud", "no file", "Send the cloud as a file part.")
        # curl sends `-F options=@file;type=application/json` as a file as well.
        if name == "cloud" or (file_format in ("npy", "png") and name != "options"):
            fields[name] = File(file_format or "", data)
        elif name in CAMERA and len(data) < MAX_CAMERA_TEXT:
            fields[name] = value_of_text(name, data.decode("utf-8", "replace"))
        else:
            fields[name] = read_json(name, data)
    image = {name: fields.pop(name) for name in CAMERA if name in fields}
    if image and "depth_images" in fields:
        raise InvalidRequest("depth_images", f"images and {next(iter(image))}", "Send one.")
    return fields | ({"depth_images": [image]} if image else {})


def _parts(body: bytes, boundary: str, most: int) -> Iterator[tuple[str, str | None, bytes]]:
    """Name, file format (None: not a file) and data of each part of a multipart body.

    The format comes from a part's content type, else from its file name.
    """
    parser = MultiPartParser(
        lambda **named: io.BytesIO(),  # type: ignore[arg-type]  # always called with keywords
        max_form_memory_size=None,
        max_form_parts=most,
    )
    try:
        if not boundary:
            raise ValueError("no boundary in its Content-Type")
        form, files = parser.parse(io.BytesIO(body), boundary.encode("utf-8", "replace"), len(body))
    except RequestEntityTooLarge:
        raise InvalidRequest("body", f"more than {most} parts", "Send each part once.") from None
    except (ValueError, HTTPException) as error:
        fix = "Send a file part `cloud` and a JSON part `options`."
        raise InvalidRequest("body", f"a form that cannot be read ({error})", fix) from None
    for name, text in form.items(multi=True):
        yield str(name), None, text.encode()
    for name, file in files.items(multi=True):
        suffix = PurePath((file.filename or "").replace("\0", "")).suffix
        yield str(name), PART_TYPES.get(file.mimetype) or suffix[1:].lower(), file.read()


# Messages


def _fields_of_message(job: Job) -> dict[str, Any]:
    """The fields of a request message.

    Raises InvalidRequest: It is not such a message, has an invalid pose, more parts than any
    request needs, or an unknown field.
    """
    scores = job.method == "ScoreGrasps"
    kind = grasp_pb2.ScoreGraspsRequest if scores else grasp_pb2.DetectGraspsRequest
    try:
        message = kind.FromString(job.body)
    except DecodeError:
        raise errors.unreadable_message(job.body) from None
    fields: dict[str, Any] = {"options": {}, **_plain(message, "request")}
    if "encoded" in fields:
        fields["cloud"] = fields.pop("encoded")
    return fields


def _plain(value: Any, name: str) -> Any:
    """A value in its JSON form, as bytes, or as File; `name` is its path, for errors."""
    if not isinstance(value, Message):
        return value
    if len(unknown := UnknownFieldSet(value)):
        numbers = sorted({unknown[row].field_number for row in range(len(unknown))})[:5]
        fix = "Send the fields of edgegrasp.v1 only; is the server older than its client?"
        raise InvalidRequest(name, f"unknown fields numbered {numbers}", fix)
    form: Callable[[Any, str], Any] = _FORMS.get(type(value), _all_fields)
    return form(value, name)


def _field(message: Message, field: Any, name: str) -> Any:
    """A field's value; refuses lists that would take minutes and gigabytes in Python."""
    value, here = getattr(message, field.name), f"{name}.{field.name}"
    if not field.is_repeated:
        return _plain(value, here)
    is_message = field.message_type is not None
    most = MAX_CANDIDATES if field.name in GIVEN else MAX_PARTS if is_message else MAX_ROWS
    if len(value) > most:
        here = here.removeprefix("request.")
        raise InvalidRequest(here, f"{len(value)} of them", f"Send at most {most}.")
    if field.type == field.TYPE_BOOL:
        return np.array(value, dtype=bool)  # a mask: millions of values, packed
    if is_message:
        return [_plain(part, f"{here}.{row}") for row, part in enumerate(value)]
    return list(value)


def _set_fields(message: Message, name: str) -> dict[str, Any]:
    return {field.name: _field(message, field, name) for field, _ in message.ListFields()}


def _all_fields(message: Message, name: str) -> dict[str, Any]:
    """The fields of a message that are set, and all lists, even empty ones."""
    return {
        field.name: _field(message, field, name)
        for field in message.DESCRIPTOR.fields
        if field.is_repeated or not field.has_presence or message.HasField(field.name)
    }


def plain_options(message: grasp_pb2.DetectOptions, name: str = "options") -> dict[str, Any]:
    """The options that are set; raises InvalidRequest if one is set in two fields."""
    options = _set_fields(message, name)
    if "object_choice" in options:
        if "objects" in options:
            value = f"{options['objects']!r} and object_choice"
            raise InvalidRequest("options.objects", value, "Send one of the two.")
        options["objects"] = options.pop("object_choice")
    return options


def _depth_image(message: grasp_pb2.DepthImage, name: str) -> dict[str, Any]:
    fields = _all_fields(message, name)
    if pose := fields.pop("T_cloud_camera"):
        fields["T_cloud_camera"] = _matrix(pose, f"{name}.T_cloud_camera")
    return fields


def _matrix(numbers: Any, name: str) -> list[list[float]]:
    if len(numbers) != 16:
        name = name.removeprefix("request.")
        raise InvalidRequest(name, f"{len(numbers)} numbers", "Send 16, row-major.")
    return [list(numbers[start : start + 4]) for start in range(0, 16, 4)]


def _in_order(message: Message, name: str) -> list[Any]:
    return [_plain(getattr(message, each.name), name) for each in message.DESCRIPTOR.fields]


def _gripper(message: grasp_pb2.GripperChoice, name: str) -> Any:
    which = message.WhichOneof("choice")
    return None if which is None else _plain(getattr(message, which), f"{name}.{which}")


def _tagged(message: Message, name: str) -> dict[str, Any]:
    """The field of the oneof `kind` that is set: its name as `kind`, and its fields."""
    which = message.WhichOneof("kind")
    if which is None:
        return {}
    return {"kind": which, **_plain(getattr(message, which), f"{name}.{which}")}


def _unless_disabled(message: Message, name: str) -> dict[str, Any] | None:
    fields = _all_fields(message, name)
    for kind in ("ransac", "auto"):  # of a support
        if kind in fields:
            fields |= {"kind": kind} | fields.pop(kind)
    return None if fields.pop("disabled") else fields


# Messages whose JSON form is not an object with all of their fields.
_FORMS: dict[type[Message], Callable[[Any, str], Any]] = {
    grasp_pb2.DetectGraspsRequest: _set_fields,
    grasp_pb2.ScoreGraspsRequest: _set_fields,
    grasp_pb2.DetectOptions: plain_options,
    grasp_pb2.Place: _set_fields,
    grasp_pb2.EncodedCloud: lambda file, _: File(file.format, file.data),
    grasp_pb2.DepthImage: _depth_image,
    grasp_pb2.HandPose: lambda hand, name: _matrix(hand.T_cloud_hand, f"{name}.T_cloud_hand"),
    grasp_pb2.Edge: _in_order,
    grasp_pb2.Pixel: _in_order,
    grasp_pb2.Vector: _in_order,
    grasp_pb2.Quaternion: _in_order,
    grasp_pb2.HandBox: _in_order,
    grasp_pb2.GripperChoice: _gripper,
    grasp_pb2.Shape: _tagged,
    grasp_pb2.Obstacle: _tagged,
    grasp_pb2.Support: _unless_disabled,
    grasp_pb2.Suppression: _unless_disabled,
}
