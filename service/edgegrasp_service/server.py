"""One process, one event loop: HTTP and gRPC over the same core."""

import asyncio
import contextlib
import ipaddress
import logging
import signal
import socket
import sys
from collections.abc import Callable, Iterator

import uvicorn

from edgegrasp_service import grpc_edge, http_edge
from edgegrasp_service.allocator import keep_freed_memory
from edgegrasp_service.backend import load_backend
from edgegrasp_service.core import GraspService
from edgegrasp_service.edge import Edge
from edgegrasp_service.errors import AddressInUse
from edgegrasp_service.grpc_edge import GrpcEdge
from edgegrasp_service.grpc_server import GrpcServer
from edgegrasp_service.http_app import create_app
from edgegrasp_service.http_edge import HttpEdge
from edgegrasp_service.http_protocol import HttpProtocol
from edgegrasp_service.logs import LogWriter, start_logging, write_line
from edgegrasp_service.metrics import Metrics
from edgegrasp_service.observer import Observer
from edgegrasp_service.observers import Observers
from edgegrasp_service.front.reload import Reloader
from edgegrasp_service.settings import Settings
from edgegrasp_service.tls import load_tls
from edgegrasp_service.tokens import load_tokens

logger = logging.getLogger(__name__)

METHODS = {*http_edge.METHODS.values(), *grpc_edge.METHODS.values()}

NOTICE_SECONDS = 0.25  # requests that come this soon after a stop are told, not cut off
KEEP_ALIVE_SECONDS = 75  # longer than clients do: no request meets a connection that closes
CLOSE_SECONDS = 0.5  # for answers on their way, and watchers of health


class Server:
    """Both transports of one service.

    Attributes:
        metrics: What /metrics shows.
        http_url: e.g. "http://127.0.0.1:8000", once ports are open.
        grpc_address: e.g. "127.0.0.1:50051", once ports are open.
        reloader: Swaps weights, tokens and certificates, once ports are open.
    """

    def __init__(
        self,
        settings: Settings,
        service: GraspService | None = None,
        observers: tuple[Observer, ...] = (),
    ) -> None:
        """Read certificates and tokens.

        Args:
            settings: What an operator set.
            service: The core; None: one with the weights of the settings, observed.
            observers: Further ones, besides the metrics.

        Raises:
            InvalidSettings: A certificate or a token cannot be used.
        """
        self._settings = settings
        self._tls = load_tls(settings)
        self.metrics = Metrics(sorted(METHODS))
        self._edge = Edge(load_tokens(settings), self.metrics, settings.max_header_bytes)
        self._service = service or GraspService(
            lambda: load_backend(settings), settings, Observers((self.metrics, *observers))
        )
        self.metrics.describe_models(self._service.models)
        self.metrics.watch("ready", "1: requests are answered", lambda: self._service.ready)
        self.reloader = Reloader(
            self._service, self._edge, lambda: load_tokens(settings), self._tls
        )
        self.http_url = ""
        self.grpc_address = ""

    async def serve(
        self,
        stop: asyncio.Event,
        opened: Callable[[], None] = lambda: None,
        ready: Callable[[], None] = lambda: None,
    ) -> None:
        """Open both ports, load the weights, answer until `stop` is set, then drain.

        Args:
            stop: Set to stop.
            opened: Called when both ports answer; requests are refused as not ready.
            ready: Called when requests are answered.

        Raises:
            AddressInUse: A port cannot be bound.
            EdgeGraspError: Weights cannot be used.
        """
        settings = self._settings
        with _listen(settings.host, settings.http_port) as http_socket:
            grpc_server = self._grpc_server()
            http_server = self._http_server()
            scheme = "http" if self._tls is None else "https"
            self.http_url = f"{scheme}://{_host_and_port(http_socket)}"
            self.grpc_address = grpc_server.address
            await grpc_server.start()
            http_task = asyncio.create_task(http_server.serve(sockets=[http_socket]))
            load_task = asyncio.create_task(self._load(grpc_server, ready))
            opened()
            stopped = asyncio.create_task(stop.wait())
            try:
                await asyncio.wait([stopped, load_task], return_when=asyncio.FIRST_COMPLETED)
                if load_task.done():
                    load_task.result()
                await stopped
            finally:
                await self._drain(grpc_server)
                http_server.should_exit = True
                await asyncio.gather(http_task, grpc_server.stop(CLOSE_SECONDS))
                for task in (stopped, load_task):
                    task.cancel()

    async def _load(self, grpc_server: GrpcServer, ready: Callable[[], None]) -> None:
        await self._service.start()
        await grpc_server.set_serving(True)
        ready()

    async def _drain(self, grpc_server: GrpcServer) -> None:
        """Refuse new requests, and wait until those accepted are answered, or grace is over."""
        clock = asyncio.get_running_loop().time
        end = clock() + self._settings.grace_seconds
        self._edge.draining = True
        self._service.stop_accepting()
        await grpc_server.stop_serving()
        await asyncio.sleep(min(NOTICE_SECONDS, self._settings.grace_seconds))
        in_time = await self._service.drain(end - clock())
        if not in_time:
            logger.warning("grace is over: requests in flight are given up")
            self._edge.give_up()
        self._service.close()
        end = max(end, clock() + CLOSE_SECONDS)
        while self._edge.unanswered and clock() < end:
            await asyncio.sleep(0.01)

    def _grpc_server(self) -> GrpcServer:
        return GrpcServer(
            self._service,
            self._settings.host,
            self._settings.grpc_port,
            interceptors=[GrpcEdge(self._edge, self._settings.max_body_bytes)],
            credentials=None if self._tls is None else self._tls.grpc,
            reloader=self.reloader,
        )

    def _http_server(self) -> "_HttpServer":
        tls = self._tls
        config = uvicorn.Config(
            HttpEdge(create_app(self._service, self.reloader), self._edge),
            log_config=None,
            access_log=False,
            lifespan="off",
            http=HttpProtocol,  # whatever else is installed: its bounds are the ones set here
            h11_max_incomplete_event_size=self._settings.max_header_bytes,
            ws="none",
            server_header=False,
            proxy_headers=False,
            timeout_keep_alive=KEEP_ALIVE_SECONDS,
            timeout_graceful_shutdown=1,  # there was grace before
            ssl_context_factory=None if tls is None else lambda config, default: tls.http,
        )
        return _HttpServer(config)


class _HttpServer(uvicorn.Server):
    """Leaves signals to the process: both transports stop together."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def run(settings: Settings) -> None:
    """Serve until SIGTERM or SIGINT; prints one line with both addresses when ready.

    Raises:
        AddressInUse: A port cannot be bound.
        EdgeGraspError: Weights cannot be used.
    """
    keep_freed_memory()
    with contextlib.ExitStack() as ends:
        log = ends.enter_context(contextlib.closing(start_logging(settings, sys.stderr)))
        observers: list[Observer] = []
        if settings.otlp_endpoint:
            from edgegrasp_service.tracing import Tracer, otlp_provider

            provider = otlp_provider(settings.otlp_endpoint)
            ends.callback(provider.shutdown)
            observers.append(Tracer(provider))
        warn_of_strangers(settings)
        asyncio.run(_serve_until_signalled(settings, tuple(observers), log))


async def _serve_until_signalled(
    settings: Settings, observers: tuple[Observer, ...], log: LogWriter
) -> None:
    stop = asyncio.Event()
    server = Server(settings, observers=observers)
    server.metrics.watch("log_lines_dropped", "log lines not written", lambda: log.dropped)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    terminal = _at_a_terminal()

    def hang_up() -> None:
        if terminal and not _at_a_terminal():  # it was closed, with nobody left to stop this
            stop.set()
        else:
            server.reloader.reload_soon()

    loop.add_signal_handler(signal.SIGHUP, hang_up)

    def opened() -> None:
        logger.info("opened %s and gRPC %s, loading", server.http_url, server.grpc_address)

    def ready() -> None:
        line = f"EdgeGrasp serves HTTP {server.http_url} gRPC {server.grpc_address}"
        write_line(sys.stdout, line)

    await server.serve(stop, opened, ready)


def _at_a_terminal() -> bool:
    return sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()


def warn_of_strangers(settings: Settings) -> None:
    """Say what is open to whoever can reach this machine."""
    try:
        local = ipaddress.ip_address(settings.host).is_loopback
    except ValueError:
        local = settings.host == "localhost"
    if not local and settings.tls_certificate is None:
        logger.warning("%s: others can reach this server, and nothing is encrypted", settings.host)
    if not local and not (load_tokens(settings).required or settings.tls_client_ca):
        logger.warning("%s: others can reach this server, and it asks nobody who", settings.host)


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listening = socket.create_server((host, port), family=family, backlog=2048)
    except OSError as error:
        raise AddressInUse(f"HTTP: cannot listen on {host}:{port} ({error.strerror})") from None
    # Connections inherit it; asyncio sets it on its own sockets only. Without, answers wait 40 ms.
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listening


def _host_and_port(listening: socket.socket) -> str:
    host, port = listening.getsockname()[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
