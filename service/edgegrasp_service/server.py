"""The front process: HTTP and gRPC in one event loop, in front of the workers."""

import asyncio
import contextlib
import errno
import gc
import ipaddress
import logging
import resource
import signal
import socket
import sys
from asyncio import constants
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.errors import AddressInUse, InvalidSettings
from edgegrasp_service.front.grpc import GrpcServer
from edgegrasp_service.front.http import HttpMiddleware, HttpProtocol, create_router
from edgegrasp_service.front.service import EvictingLimiter, GraspService
from edgegrasp_service.observability import LogQueue, Metrics, start_logging, write_line
from edgegrasp_service.settings import UNIX_PREFIX, Settings
from edgegrasp_service.worker.process import PIECE_BYTES, ForkServer, WorkerPool
from edgegrasp_service.worker.recording import check_outcomes

logger = logging.getLogger(__name__)

# Connections of HTTP
HEALTH_PLACES = 16  # in addition to max_connections; never taken by requests to /v1/
BACKLOG = 1024  # waiting to be accepted; beyond that a client retries after a second
MAX_ACCEPTED_AT_ONCE = 16  # in one turn of the event loop
KEEP_ALIVE_SECONDS = 75  # clients close earlier, so no request arrives on a closing connection

NOTICE_SECONDS = 0.25  # seconds; requests that arrive this soon after a stop are still answered
CLOSE_SECONDS = 0.5  # seconds for answers being sent, and for health watchers
REPEAT_SECONDS = 10.0  # seconds between log lines about the same socket error


class Server:
    """Both transports; create it in the running event loop. Raises InvalidSettings."""

    def __init__(self, settings: Settings, fork_server: ForkServer | None = None) -> None:
        self._settings = settings
        self.metrics = Metrics(lambda: self.pool.models)
        self.pool = WorkerPool(settings, self.metrics.workers_replaced.inc, fork_server)
        self.service = GraspService(settings, self.pool, self.metrics)
        if settings.outcomes_file is not None:
            check_outcomes(settings.outcomes_file)
        service, admission = self.service, self.service.admission
        watch = self.metrics.add_gauge
        watch("ready", "1: requests are answered", lambda: service.ready)
        watch("requests_in_flight", "requests not yet answered", lambda: len(admission.calls))
        watch("requests_active", "requests that workers have", lambda: admission.num_at_work)
        waiting = "admitted requests that no worker has yet"
        watch("queue_depth", waiting, lambda: len(admission.calls) - admission.num_at_work)
        watch("held_bytes", "bytes of bodies in the server", lambda: admission.held_bytes)
        watch("workers", "worker processes", lambda: len(self.pool.pids))
        self.http_url = self.grpc_address = ""  # once ports are open: http://host:port, host:port

    async def serve(self, stop: asyncio.Event, ready: Callable[[], None]) -> None:
        """Open both ports, load the weights, serve until `stop` is set, then drain.

        Both ports answer once `http_url` is set, though requests are refused as not ready until
        `ready` is called.

        Raises:
            AddressInUse: A port cannot be bound.
            EdgeGraspError: Weights cannot be used.
        """
        settings = self._settings
        asyncio.get_running_loop().set_exception_handler(_LoopErrors())
        with _listen(settings.host, settings.http_port) as http_socket:
            http_connections = EvictingLimiter(settings.max_connections, spare=HEALTH_PLACES)
            grpc_server = GrpcServer(self.service)
            http_server = self._http_server(http_connections)
            await grpc_server.server.start()
            trimming = asyncio.create_task(grpc_server.trim(http_connections.taken))
            http_task = asyncio.create_task(http_server.serve(sockets=[http_socket]))
            load_task = asyncio.create_task(self._load(ready))
            scheme = "http" if self.service.tls is None else "https"
            self.http_url, self.grpc_address = _url(scheme, http_socket), grpc_server.address
            logger.info("opened %s and gRPC %s, loading", self.http_url, self.grpc_address)
            stopped = asyncio.create_task(stop.wait())
            try:
                await asyncio.wait([stopped, load_task], return_when=asyncio.FIRST_COMPLETED)
                if load_task.done():
                    load_task.result()
                await stopped
            finally:
                load_task.cancel()
                self.service.stopping.set()  # new requests are refused, accepted ones answered
                notice = min(NOTICE_SECONDS, self._settings.grace_seconds)
                await asyncio.sleep(notice)
                await self.service.drain(self._settings.grace_seconds - notice)
                http_server.should_exit = True
                await asyncio.gather(http_task, grpc_server.server.stop(CLOSE_SECONDS))
                stopped.cancel()
                trimming.cancel()
                self.pool.close()
                if self.service.recorder is not None:
                    self.service.recorder.close()

    async def _load(self, ready: Callable[[], None]) -> None:
        await self.pool.start()
        gc.freeze()  # a collection that visits every module stops the event loop for 100 ms
        if not self.service.stopping.is_set():
            ready()

    def _http_server(self, limiter: EvictingLimiter) -> "_HttpServer":
        tls = self.service.tls
        config = uvicorn.Config(
            HttpMiddleware(create_router(self.service, self.metrics), self.service),
            log_config=None,
            access_log=False,
            lifespan="off",
            http=partial(HttpProtocol, self.service, limiter),  # type: ignore[arg-type]
            ws="none",
            backlog=MAX_ACCEPTED_AT_ONCE,
            server_header=False,
            proxy_headers=False,
            timeout_keep_alive=KEEP_ALIVE_SECONDS,
            timeout_graceful_shutdown=1,  # the grace period is already over
            ssl_context_factory=None if tls is None else lambda config, default: tls.http,
        )
        return _HttpServer(config)


class _HttpServer(uvicorn.Server):
    """Leaves signals to the process, so that both transports stop together."""

    capture_signals = contextlib.nullcontext  # type: ignore[assignment]

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, with a backlog larger than the number accepted at once."""
        await super().startup(sockets)
        for one in sockets or ():
            one.listen(BACKLOG)


class _LoopErrors:
    """Logs errors of the event loop; repeated socket errors are logged rarely, in one line.

    Without free file descriptors, every waiting connection would log a traceback.
    """

    def __init__(self) -> None:
        self._next = 0.0

    def __call__(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        # A socket that is closed before it accepts again has no descriptor and raises ValueError.
        if not isinstance(error, OSError) and "Invalid file descriptor" not in str(error):
            loop.default_exception_handler(context)
        elif loop.time() >= self._next:
            self._next = loop.time() + REPEAT_SECONDS
            logger.error("%s (%s)", context["message"], error)


def run(settings: Settings, fork_server: ForkServer | None = None) -> None:
    """Serve until SIGTERM or SIGINT; prints one line with both addresses when ready.

    `fork_server`, if given, is already loading the weights.

    Raises:
        AddressInUse: A port cannot be bound.
        EdgeGraspError: Weights cannot be used.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError):  # the usual 1024 are too few for all connections
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    # A connection takes no permit before its TLS handshake, so the handshake's time is limited.
    constants.SSL_HANDSHAKE_TIMEOUT = settings.read_seconds
    with contextlib.closing(start_logging(settings, sys.stderr)) as log:
        warn(settings)
        asyncio.run(_serve_until_signalled(settings, log, fork_server))


async def _serve_until_signalled(
    settings: Settings, log: LogQueue, fork_server: ForkServer | None
) -> None:
    stop = asyncio.Event()
    server = Server(settings, fork_server)
    server.metrics.add_gauge("log_lines_dropped", "log lines not written", lambda: log.dropped)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # process 1 of a container inherits dead workers
    terminal = _at_a_terminal()

    async def reload() -> None:
        try:
            await server.service.reload()
        except EdgeGraspError as error:
            logger.warning("SIGHUP: %s", error)

    def hang_up() -> None:
        if terminal and not _at_a_terminal():  # stdout was closed
            stop.set()
        else:
            server.pool.spawn(reload())

    loop.add_signal_handler(signal.SIGHUP, hang_up)

    def ready() -> None:
        line = f"EdgeGrasp serves HTTP {server.http_url} gRPC {server.grpc_address}"
        write_line(sys.stdout, line)

    await server.serve(stop, ready)


def _at_a_terminal() -> bool:
    return sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()


def warn(settings: Settings) -> None:
    """Warn about settings that an operator may not have intended."""
    try:
        local = ipaddress.ip_address(settings.host).is_loopback
    except ValueError:
        local = settings.host == "localhost" or settings.host.startswith(UNIX_PREFIX)
    if not local and settings.tls_certificate is None:
        logger.warning("%s: others can reach this server, and nothing is encrypted", settings.host)
    if not local and not (settings.token_file or settings.tls_client_ca):
        logger.warning("%s: others can reach this server without a token", settings.host)
    for folder in settings.weights:
        if folder.is_dir() and not any(folder.glob("*.safetensors")):
            logger.warning("weights: %s contains no weights (*.safetensors)", folder)


def _listen(host: str, port: int) -> socket.socket:
    family, place = socket.AF_INET6 if ":" in host else socket.AF_INET, f"{host}:{port}"
    address: Any = (host, port)
    if host.startswith(UNIX_PREFIX):
        if host == UNIX_PREFIX:
            raise InvalidSettings(f"host: got {host!r}. Give unix:FOLDER.")
        family, place = socket.AF_UNIX, f"{host.removeprefix(UNIX_PREFIX)}/http.sock"
        address = place
        with socket.socket(socket.AF_UNIX) as trying:  # remove a stale socket
            if trying.connect_ex(place) == errno.ECONNREFUSED:
                Path(place).unlink(missing_ok=True)
    try:
        both = host == "::" and socket.has_dualstack_ipv6()  # as gRPC does
        listening = socket.create_server(
            address, family=family, backlog=BACKLOG, dualstack_ipv6=both
        )
    except OSError as error:
        if family != socket.AF_UNIX and error.errno not in (errno.EADDRINUSE, errno.EACCES):
            fix = "Give an address of this machine."
            raise InvalidSettings(f"host: got {host!r} ({error.strerror}). {fix}") from None
        raise AddressInUse("HTTP", place, str(error.strerror)) from None
    if family != socket.AF_UNIX:
        # Connections inherit it; asyncio sets it only on its own sockets. Without it, answers were
        # delayed by 40 ms.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # Data that a client does not read stays in this process, which counts it.
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, PIECE_BYTES)
    return listening


def _url(scheme: str, listening: socket.socket) -> str:
    if listening.family == socket.AF_UNIX:
        return f"{scheme}+unix:{listening.getsockname()}"
    host, port = listening.getsockname()[:2]
    return f"{scheme}://[{host}]:{port}" if ":" in host else f"{scheme}://{host}:{port}"
