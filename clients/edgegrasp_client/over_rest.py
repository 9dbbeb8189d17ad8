"""The REST transport: requests, answers and errors over HTTP."""

import asyncio
import base64
import json
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping, Sequence
from functools import partial
from typing import Any

import httpx
import numpy as np

from edgegrasp_camera.depth import ENCODINGS
from edgegrasp_client import errors
from edgegrasp_client.connection import (
    HTTP_OVER_UNIX,
    Tls,
    invalid,
    is_local,
    ssl_context,
    token_metadata,
    unreachable,
)
from edgegrasp_client.requests import Request, cloud_file, npy_bytes
from edgegrasp_client.results import Answer, StreamAnswer, error_of_kind, read_as
from edgegrasp_results import Detection

MAX_QUERY_LENGTH = 4000  # characters; servers and proxies limit the length of an address
KIND_PREFIX = "urn:edgegrasp:error:"
# Kinds of errors for statuses that do not come from a grasp service, but e.g. from a proxy.
FOREIGN_KINDS = {413: "payload-too-large", 429: "overloaded"}
FOREIGN_KINDS |= dict.fromkeys((500, 502, 503, 504), "internal")

Call = dict[str, Any]  # arguments of httpx's `request`
Part = tuple[str | None, bytes, str]  # a part of a form: file name, content, media type


class RestTransport:
    """Posts over connections that are kept open; raises GraspClientErrors."""

    def __init__(self, address: str, token: str | None, tls: Tls | None) -> None:
        self._address, socket, transport = address, None, None
        if tls is not None and not address.startswith("https:"):
            raise invalid("tls", f"a Tls for {address}", "Give an https:// address.")
        if address.startswith(HTTP_OVER_UNIX):
            socket, address = address.removeprefix(HTTP_OVER_UNIX), "http://localhost"
        context = True if tls is None else ssl_context(tls)
        if is_local(address):  # with an explicit transport, httpx uses no proxy
            transport = httpx.AsyncHTTPTransport(verify=context, uds=socket)
        try:
            self._http = httpx.AsyncClient(
                base_url=address,
                headers=dict(token_metadata(token)),
                verify=context,
                transport=transport,
            )
            if (self._http.base_url.port or 0) > 65535:
                raise httpx.InvalidURL("no such port")
        except httpx.InvalidURL as error:
            raise invalid("address", f"{address!r} ({error})", "Give http://host:port.") from None

    async def request(self, kind: type[Answer], request: Request, timeout: float) -> Answer:
        """The answer to a request."""
        return await self._call(partial(read_as, kind), call_of(request), timeout)

    async def list_all(self, kind: type[Answer], timeout: float) -> list[Answer]:
        """The server's models or robots."""
        name = f"{kind.__name__.lower()}s"
        call = {"method": "GET", "url": f"/v1/{name}"}
        return await self._call(
            lambda body: [read_as(kind, each) for each in body[name]], call, timeout
        )

    async def record_outcome(self, tried: dict[str, Any], timeout: float) -> None:
        """Report to the server whether a grasp held."""
        call = {"method": "POST", "url": "/v1/outcomes", "json": tried}
        await self._call(lambda _: None, call, timeout)

    async def detect_stream(
        self, requests: AsyncIterator[tuple[str, Request, float]]
    ) -> AsyncGenerator[StreamAnswer, None]:
        """An answer to each request, one after another; a request comes with its id and timeout."""
        async for name, request, seconds in requests:
            try:
                yield StreamAnswer(name, await self.request(Detection, request, seconds))
            except errors.GraspClientError as error:
                yield StreamAnswer(name, error=error)

    async def ready(self, timeout: float) -> bool:
        """Whether the server answers requests."""
        try:
            asking = self._http.get("/health/ready", timeout=timeout)
            return (await asyncio.wait_for(asking, timeout)).is_success
        except (httpx.HTTPError, asyncio.TimeoutError):
            return False

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def _call(self, read: Callable[[Any], Answer], call: Call, timeout: float) -> Answer:
        """The parsed answer of a call; client and server give up after `timeout` seconds."""
        headers = {**call.get("headers", {}), "x-request-timeout": f"{timeout:.6g}"}
        asking = self._http.request(**call | {"headers": headers}, timeout=timeout)
        try:  # httpx restarts its timeout for connecting, sending and each part of an answer
            response = await asyncio.wait_for(asking, timeout)
        except (httpx.TimeoutException, asyncio.TimeoutError) as error:
            raise errors.DeadlineError(f"No answer in time ({type(error).__name__}).") from None
        except (httpx.HTTPError, RuntimeError) as error:  # the latter of a closed client
            raise unreachable(self._address, str(error) or type(error).__name__) from None
        try:
            body = response.json()
            if not response.is_success:
                raise _described(body)
            return read(body)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise _foreign(response) from error


def call_of(request: Request) -> Call:
    """The HTTP call of a request; raises InvalidRequestError for a value that does not fit in it.

    Sends a point cloud file as the body and options as query parameters, or a form if there is
    more.
    """
    query = {name: _text(f"options.{name}", value) for name, value in request.options.items()}
    parts: dict[str, Part] = {"options": _json_part("options", request.options)}
    if request.cloud is None:
        parts |= _image_parts(request.depth_images)
    else:
        file_format, data = cloud_file(request.cloud)
        media = f"application/x-{file_format}"
        if not request.arrays and sum(map(len, query.values())) < MAX_QUERY_LENGTH:
            post = {"method": "POST", "url": "/v1/grasps", "headers": {"content-type": media}}
            return {**post, "params": query, "content": data}
        parts["cloud"] = (f"cloud.{file_format}", data, media)
    for name, array in request.arrays.items():
        parts[name] = (f"{name}.npy", npy_bytes(array), "application/x-npy")
    path = "/v1/grasps:score" if request.scores else "/v1/grasps"
    return {"method": "POST", "url": path, "files": parts}


def _image_parts(images: Sequence[Mapping[str, Any]]) -> dict[str, Part]:
    """The parts of one image, with the depths as a file; for several images, one JSON part."""
    if len(images) != 1:
        return {"depth_images": _json_part("depth_images", images)}
    camera = dict(images[0])
    depth = camera.pop("depth")
    file_format, data = depth["encoding"], depth["data"]
    if file_format != "png":
        pixels = np.frombuffer(data, ENCODINGS[file_format])
        file_format, data = "npy", npy_bytes(pixels.reshape(depth["height"], depth["width"]))
    file = f"depth.{file_format}", data, f"application/x-{file_format}"
    return {"depth": file} | {name: _json_part(name, value) for name, value in camera.items()}


def _json_part(name: str, value: object) -> Part:
    return None, _text(name, value).encode(), "application/json"


def _text(name: str, value: object) -> str:
    if isinstance(value, str):
        return value
    try:
        return json.dumps(value, default=_base64)
    except (TypeError, ValueError) as error:
        raise invalid(name, repr(value)[:80], f"{error}.") from None


def _base64(value: object) -> str:
    if isinstance(value, np.ndarray):  # a mask
        value = value.tobytes()
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    raise TypeError(f"a {type(value).__name__} is not a JSON value")


def _described(problem: Mapping[str, Any]) -> errors.GraspClientError:
    """The exception for a server's problem document; raises KeyError for other documents."""
    said = (problem[name] for name in ("detail", "field", "value", "fix"))
    kind = problem["type"].removeprefix(KIND_PREFIX)
    return error_of_kind(kind, *said, retry_after=problem["retry_after"])


def _foreign(response: httpx.Response) -> errors.GraspClientError:
    """The exception for an answer that is not from a grasp service, but e.g. from a proxy."""
    status, retry_after = response.status_code, response.headers.get("retry-after", "")
    seconds = float(retry_after) if retry_after.isdecimal() else None  # it may also be a date
    kind = "overloaded" if status == 503 and seconds is not None else FOREIGN_KINDS.get(status, "")
    what = f"{response.request.url} answered {status} {response.reason_phrase}"
    what += "." if kind else ", which is not the answer of a grasp service."
    return error_of_kind(kind, what, retry_after=seconds)
