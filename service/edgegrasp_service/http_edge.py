"""The edge of the HTTP transport: tokens, request ids, metrics, and a log line for each request."""

from fastapi.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from edgegrasp_service.edge import Answered, Edge, GivenUp, check_headers
from edgegrasp_service.errors import ServiceError, UnsupportedMediaType, report
from edgegrasp_service.http_problem import problem_response
from edgegrasp_service.request_id import HEADER
from edgegrasp_service.tokens import HEADER as AUTHORIZATION

METRICS = "/metrics"
RELOAD = "/v1/models:reload"

# Values of the label `method`: the gRPC method's name where there is one.
METHODS = {
    "/v1/grasps": "DetectGrasps",
    "/v1/grasps:score": "ScoreGrasps",
    "/v1/models": "ListModels",
    RELOAD: "ReloadModels",
    "/health/live": "Live",
    "/health/ready": "Ready",
    METRICS: "Metrics",
    "/docs": "Docs",
    "/openapi.json": "Docs",
}
UNANSWERED = "499"  # the caller went away; as nginx logs it
OPEN = ("Live", "Ready")  # without a token: who restarts a server need not know one


class HttpEdge:
    """ASGI middleware outside of everything else, the framework's own errors included."""

    def __init__(self, app: ASGIApp, edge: Edge) -> None:
        self._app = app
        self._edge = edge

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = {
            name.decode("latin-1").lower(): value.decode("latin-1")
            for name, value in scope["headers"]
        }
        method = METHODS.get(scope["path"], "other")
        answered = Answered(UNANSWERED)
        with self._edge.request("http", method, headers, answered) as request_id:

            async def send_named(message: Message) -> None:
                if message["type"] == "http.response.start":
                    answered.code = str(message["status"])
                    extra = [(HEADER.encode(), request_id.encode())]
                    if self._edge.draining:
                        extra.append((b"connection", b"close"))
                    message = {**message, "headers": [*message.get("headers", []), *extra]}
                await send(message)

            try:
                self._check(scope, method, headers)
            except ServiceError as error:
                await problem_response(report(error))(scope, receive, send_named)
                return
            app = self._metrics(headers) if method == "Metrics" else self._app
            try:
                with self._edge.until_given_up():
                    await app(scope, receive, send_named)
            except GivenUp as error:
                if answered.code == UNANSWERED:
                    await problem_response(report(error.reason))(scope, receive, send_named)

    def _check(self, scope: Scope, method: str, headers: dict[str, str]) -> None:
        size = sum(len(name) + len(value) for name, value in scope["headers"])
        size += len(scope["raw_path"]) + len(scope["query_string"])
        check_headers("headers", len(scope["headers"]), size, self._edge.max_header_bytes)
        if method not in OPEN:
            admin = method == "ReloadModels"
            self._edge.tokens.check(headers.get(AUTHORIZATION), admin=admin)
        if (encoding := headers.get("content-encoding", "identity").lower()) != "identity":
            fix = "Send the body as it is; .npz and .pcd files may be compressed inside."
            raise UnsupportedMediaType("Content-Encoding", repr(encoding[:40]), fix)

    def _metrics(self, headers: dict[str, str]) -> Response:
        body, content_type = self._edge.metrics.page(headers.get("accept", ""))
        return PlainTextResponse(body, headers={"content-type": content_type})
