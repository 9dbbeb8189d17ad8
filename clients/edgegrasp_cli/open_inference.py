"""`edgegrasp open-inference`: the Open Inference Protocol v2 in front of a grasp server.

Runs as a client of the server, in its own process: it converts the bytes of tensors to arrays and
passes them on. The server's workers decode them.
"""

import json
import math
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Annotated, Any

import grpc
import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from typer import Option

from edgegrasp.oip import open_inference_pb2 as messages
from edgegrasp_camera.arrays import Array
from edgegrasp_cli.flags import ServerFlags, takes_flags
from edgegrasp_client import GraspClient, errors
from edgegrasp_client.connection import invalid
from edgegrasp_client.requests import option_of_text, plain_options

PLATFORM = "edgegrasp"
VERSION = "1"  # of the tensors' names and meaning
DTYPES = {"FP32": "<f4", "FP64": "<f8", "UINT16": "<u2", "INT32": "<i4"}
CONTENT_FIELDS = {"FP32": "fp32_contents", "FP64": "fp64_contents"}
CONTENT_FIELDS |= {"UINT16": "uint_contents", "INT32": "int_contents"}
INPUTS = {"points": ("FP32", [-1, 3]), "depth": ("FP32", [-1, -1]), "intrinsics": ("FP32", [4])}
OUTPUTS = {  # fields of a Grasp
    "T_cloud_hand": ("FP32", [-1, 4, 4]),  # best first, like all outputs
    "score": ("FP32", [-1]),
    "width": ("FP32", [-1]),  # metres
    "object": ("INT32", [-1]),  # -1: on no object
}
# Parameters of the protocol and of Triton's clients about serving, which are not options.
SERVING_PARAMETERS = {"binary_data_output", "headers", "priority", "timeout"}
SERVING_PARAMETERS |= {"sequence_id", "sequence_start", "sequence_end"}
STATUS: tuple[tuple[type[Exception], str, int], ...] = (  # the first that matches applies
    (errors.UnknownModelError, "NOT_FOUND", 404),
    (errors.PayloadTooLargeError, "RESOURCE_EXHAUSTED", 413),
    (errors.InvalidRequestError, "INVALID_ARGUMENT", 400),
    (errors.AccessDeniedError, "PERMISSION_DENIED", 403),
    (errors.OverloadedError, "RESOURCE_EXHAUSTED", 429),
    (errors.ServerUnavailableError, "UNAVAILABLE", 503),
    (errors.DeadlineError, "DEADLINE_EXCEEDED", 504),
    (errors.GraspClientError, "INTERNAL", 500),
)
PARALLEL_CALLS = 32
MAX_BODY_BYTES = 32 * 2**20
MAX_SHORT_LISTS = 20_000  # in JSON; most lists contain numbers

Tensors = dict[str, Array]


@takes_flags()
def open_inference(
    host: Annotated[str, Option(help="Address to listen at.")] = "127.0.0.1",
    http_port: Annotated[int, Option(help="Port of REST.")] = 8080,
    grpc_port: Annotated[int, Option(help="Port of gRPC.")] = 8081,
    name: Annotated[str, Option(help="Model name for the server's default weights.")] = "default",
    *,
    flags: ServerFlags,
) -> None:
    """Answer the Open Inference Protocol v2 (KServe, Triton's clients) for a grasp server.

    It does not require a token: put a gateway in front of it that checks tokens.
    """
    # When it has stopped, uvicorn raises the signal again; gRPC has calls to finish.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with flags.connect(flags.server) as client:
        models = Models(client, name, flags.timeout)
        place = f"[{host}]" if ":" in host else host  # IPv6 is in brackets
        with grpc_server(models, f"{place}:{grpc_port}"):
            addresses = f"http://{place}:{http_port} and gRPC {place}:{grpc_port}"
            print(f"Open Inference on {addresses}", flush=True)
            uvicorn.run(http_app(models), host=host, port=http_port, log_level="warning")


def refusal(error: errors.GraspClientError) -> tuple[str, int, str]:
    """The gRPC code's name, the HTTP status and the reason."""
    code, status = next(row[1:] for row in STATUS if isinstance(error, row[0]))
    return code, status, str(error).encode("utf-8", "backslashreplace").decode()


class Models:
    """The weights of a grasp server as models of the protocol; raises GraspClientErrors.

    `default` is a second name for the server's default weights.
    """

    def __init__(self, client: GraspClient, default: str, timeout: float) -> None:
        self._client, self._default, self._timeout = client, default, timeout

    def ready(self) -> bool:
        """Whether the server answers requests."""
        return self._client.ready(timeout=5.0)

    def names(self) -> list[str]:
        """The models' names."""
        return [self._default, *(model.name for model in self._client.models())]

    def require(self, name: str, version: str = "") -> bool:
        """Return True; raises UnknownModelError for an unknown name or version."""
        known = self.names()
        if name not in known:
            raise errors.UnknownModelError(f"No model {name!r}. Use one of: {', '.join(known)}.")
        if version not in ("", VERSION):
            raise errors.UnknownModelError(f"No version {version!r}. Use {VERSION}.")
        return True

    def metadata(self, name: str, version: str = "") -> dict[str, Any]:
        """The inputs and outputs of a model, as the protocol describes them."""
        self.require(name, version)
        inputs, outputs = (
            [{"name": each, "datatype": kind, "shape": shape} for each, (kind, shape) in table]
            for table in (INPUTS.items(), OUTPUTS.items())
        )
        about = {"name": name, "versions": [VERSION], "platform": PLATFORM}
        return {**about, "inputs": inputs, "outputs": outputs}

    def infer(
        self,
        name: str,
        version: str,
        inputs: Tensors,
        parameters: Mapping[str, Any],
        wanted: Sequence[str],
        timeout: float = math.inf,
    ) -> dict[str, Any]:
        """Find grasps in `points`, or in `depth` with `intrinsics`; `parameters` are options.

        The parameter `timeout` is in microseconds; `wanted` are names of outputs, empty: all. The
        answer has the protocol's form, with an array as the `data` of each output.
        """
        if version:
            self.require(name, version)
        asked = {key: option_of_text(value) for key, value in parameters.items()}
        options: Any = {key: value for key, value in asked.items() if key not in SERVING_PARAMETERS}
        if name != self._default:
            options["model"] = name
        given = set(inputs)
        if given == {"points"}:
            cloud: dict[str, Any] = {"cloud": inputs["points"]}
        elif given == {"depth", "intrinsics"}:
            image = {"depth": inputs["depth"], "intrinsics": inputs["intrinsics"].ravel()}
            cloud = {"depth_images": [image]}
        else:
            named = ", ".join(sorted(given)) or "nothing"
            raise invalid("inputs", named, "Send points, or depth and intrinsics.")
        if unknown := sorted(set(wanted) - set(OUTPUTS)):
            raise invalid("outputs", unknown[0], f"Ask for {', '.join(OUTPUTS)}.")
        plain_options(options)  # refuses other arguments of the client
        seconds = min(timeout, self._timeout)
        micro = asked.get("timeout")
        if isinstance(micro, int | float) and micro > 0:
            seconds = min(seconds, micro / 1e6)
        found = self._client.detect(**cloud, **options, timeout=seconds)
        outputs = []
        for each in dict.fromkeys(wanted or OUTPUTS):
            kind, shape = OUTPUTS[each]
            values = [getattr(grasp, each) for grasp in found.grasps]
            array = tensor(each, kind, shape, [-1 if value is None else value for value in values])
            outputs.append({"name": each, "datatype": kind, "shape": array.shape, "data": array})
        said = {"model": found.model, "warnings": " ".join(found.warnings)}
        answer = {"model_name": name, "model_version": VERSION}
        return answer | {"outputs": outputs, "parameters": said}


def tensor(name: str, datatype: str, shape: Any, data: Any) -> Array:
    """An array from little-endian bytes or nested or flat lists; raises InvalidRequestError."""
    try:
        dtype = DTYPES[datatype]
        raw = isinstance(data, bytes)
        array = np.frombuffer(data, dtype) if raw else np.asarray(data, dtype)
        if not raw and "INT" in datatype and (array != np.asarray(data)).any():
            raise ValueError(f"values that {datatype} does not hold")
        return array.reshape([int(size) for size in shape])
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        why = f"a datatype {datatype}" if isinstance(error, KeyError) else str(error)
        fix = f"Give {', '.join(DTYPES)}, as many values as the shape has."
        raise invalid(f"inputs.{name}", why, fix) from None


@contextmanager
def grpc_server(models: Models, address: str) -> Iterator[int]:
    """Serve `inference.GRPCInferenceService` while the context lasts; yields its port."""
    # For each call, a function that returns the fields of its answer.
    calls: dict[str, Callable[[Any, Any], dict[str, Any]]] = {
        "ServerLive": lambda *_: {"live": True},
        "ServerReady": lambda *_: {"ready": models.ready()},
        "ServerMetadata": lambda *_: {"name": PLATFORM, "version": VERSION},
        "ModelReady": lambda asked, _: {"ready": models.require(asked.name, asked.version)},
        "ModelMetadata": lambda asked, _: models.metadata(asked.name, asked.version),
        "ModelInfer": partial(_grpc_infer, models),
    }
    handlers = {
        name: grpc.unary_unary_rpc_method_handler(
            partial(_grpc_answer, name, fields_of),
            getattr(messages, f"{name}Request").FromString,
            getattr(messages, f"{name}Response").SerializeToString,
        )
        for name, fields_of in calls.items()
    }
    service = grpc.method_handlers_generic_handler("inference.GRPCInferenceService", handlers)
    # Otherwise a second gateway at the port would get some of the calls.
    options = [("grpc.max_receive_message_length", MAX_BODY_BYTES), ("grpc.so_reuseport", 0)]
    server = grpc.server(ThreadPoolExecutor(PARALLEL_CALLS), [service], options=options)
    try:
        port = server.add_insecure_port(address)
    except RuntimeError as error:
        raise OSError(f"gRPC: got {address}, where it cannot listen. {error}") from None
    server.start()
    try:
        yield port
    finally:
        server.stop(grace=5.0).wait()


def _grpc_answer(name: str, fields_of: Callable[[Any, Any], Any], request: Any, call: Any) -> Any:
    """The answer to a call, or the client's error in the protocol's form."""
    try:
        return getattr(messages, f"{name}Response")(**fields_of(request, call))
    except errors.GraspClientError as error:
        code, _, why = refusal(error)
        call.abort(grpc.StatusCode[code], why)


def _grpc_infer(models: Models, request: Any, call: Any) -> dict[str, Any]:
    raw = list(request.raw_input_contents)
    if raw and len(raw) != len(request.inputs):
        value = f"{len(raw)} for {len(request.inputs)} inputs"
        raise invalid("raw_input_contents", value, "Give each one.")
    tensors = {}
    for number, each in enumerate(request.inputs):
        if each.name in tensors:
            raise invalid("inputs", f"{each.name} twice", "Give each one once.")
        field = CONTENT_FIELDS.get(each.datatype, "fp32_contents")
        data = raw[number] if raw else getattr(each.contents, field)
        tensors[each.name] = tensor(each.name, each.datatype, each.shape, data)
    kinds = {key: one.WhichOneof("parameter_choice") for key, one in request.parameters.items()}
    given = {key: kind and getattr(request.parameters[key], kind) for key, kind in kinds.items()}
    wanted = [each.name for each in request.outputs]
    model, left = (request.model_name, request.model_version), call.time_remaining()
    seconds = math.inf if left is None else max(left, 1e-6)  # the client refuses 0
    answer = models.infer(*model, tensors, given, wanted, seconds)
    said = {key: {"string_param": text} for key, text in answer["parameters"].items()}
    contents = [output.pop("data").tobytes() for output in answer["outputs"]]
    return {**answer, "id": request.id, "parameters": said, "raw_output_contents": contents}


def http_app(models: Models) -> Starlette:
    """The REST paths of the protocol."""

    def answers(body_of: Callable[..., Any]) -> Callable[[Request], Response]:
        return lambda request: JSONResponse(body_of(**request.path_params))

    def ready(request: Request) -> Response:
        is_ready = models.ready()
        return JSONResponse({"ready": is_ready}, 200 if is_ready else 503)

    def model_ready(name: str, version: str = "") -> dict[str, Any]:
        return {"name": name, "ready": models.require(name, version)}

    async def infer(request: Request) -> Response:
        body = bytearray()
        async for chunk in request.stream():
            body += chunk
            if len(body) > MAX_BODY_BYTES:
                raise errors.PayloadTooLargeError(f"The body is over {MAX_BODY_BYTES:,} bytes.")
        header = request.headers.get("inference-header-content-length")
        work = partial(_http_infer, models, body=body, header=header, **request.path_params)
        return JSONResponse(await run_in_threadpool(work))

    def refused(request: Request, error: Exception) -> Response:
        assert isinstance(error, errors.GraspClientError)
        _, status, why = refusal(error)
        return JSONResponse({"error": why}, status)

    state = {"version": VERSION, "state": "READY", "reason": ""}
    index = answers(lambda: [{"name": name, **state} for name in models.names()])
    routes = [
        Route("/v2", answers(lambda: {"name": PLATFORM, "version": VERSION, "extensions": []})),
        Route("/v2/health/live", answers(lambda: {"live": True})),
        Route("/v2/health/ready", ready),
        Route("/v2/models", answers(lambda: {"models": models.names()})),
        Route("/v2/repository/index", index, methods=["POST"]),
    ]
    for path in ("/v2/models/{name}", "/v2/models/{name}/versions/{version}"):
        routes += [
            Route(path, answers(models.metadata)),
            Route(f"{path}/ready", answers(model_ready)),
            Route(f"{path}/infer", infer, methods=["POST"]),
        ]
    return Starlette(routes=routes, exception_handlers={errors.GraspClientError: refused})


def _http_infer(
    models: Models, name: str, body: bytearray, header: str | None, version: str = ""
) -> dict[str, Any]:
    """The answer to the body of an inference; raises GraspClientErrors."""
    try:
        head = len(body) if header is None else min(int(header), len(body))
        lists = body.count(b"[", 0, head)
        if lists > head // 7 + MAX_SHORT_LISTS:  # each takes 20 times its size in memory
            raise ValueError(f"{lists} lists in {head} bytes")
        request = json.loads(body[:head])
        # Otherwise it could not be sent back.
        json.dumps(request.get("id", ""), allow_nan=False, ensure_ascii=False).encode()
        tensors: Tensors = {}
        binary, start = bytes(body[head:]), 0  # tensors without `data`, one after another
        for each in request["inputs"]:
            data = each.get("data")
            if data is None:
                end = start + int(each["parameters"]["binary_data_size"])
                data, start = binary[start:end], end
            if not isinstance(each["name"], str) or each["name"] in tensors:
                raise TypeError("a name that is not text or is there twice")
            tensors[each["name"]] = tensor(each["name"], each["datatype"], each["shape"], data)
        parameters = dict((request.get("parameters") or {}).items())
        wanted = [str(each["name"]) for each in request.get("outputs") or ()]
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        fix = "Give the JSON of an inference request"
        fix += ", and its length in Inference-Header-Content-Length if tensors follow it."
        raise invalid("body", f"{type(error).__name__}: {error}", fix) from None
    answer = models.infer(name, version, tensors, parameters, wanted)
    for output in answer["outputs"]:
        output["data"] = output["data"].ravel().tolist()
    return answer | {"id": request.get("id", "")}
