"""One process, one event loop: HTTP and gRPC over the same core."""

import asyncio
import contextlib
import logging
import signal
import socket
import sys
from collections.abc import Callable, Iterator

import uvicorn

from edgegrasp_service.backend import load_backend
from edgegrasp_service.core import GraspService
from edgegrasp_service.errors import AddressInUse
from edgegrasp_service.grpc_server import GrpcServer
from edgegrasp_service.http_app import create_app
from edgegrasp_service.settings import Settings

logger = logging.getLogger(__name__)


class Server:
    """Both transports of one service.

    Attributes:
        http_url: e.g. "http://127.0.0.1:8000", once ports are open.
        grpc_address: e.g. "127.0.0.1:50051", once ports are open.
    """

    def __init__(self, settings: Settings, service: GraspService | None = None) -> None:
        self._settings = settings
        self._service = service or GraspService(lambda: load_backend(settings), settings.max_points)
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
            grpc_server = GrpcServer(
                self._service, settings.host, settings.grpc_port, settings.max_body_bytes
            )
            http_server = self._http_server()
            self.http_url = f"http://{_host_and_port(http_socket)}"
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
                self._service.drain()
                http_server.should_exit = True
                await asyncio.gather(http_task, grpc_server.stop(settings.grace_seconds))
                self._service.close()
                for task in (stopped, load_task):
                    task.cancel()

    async def _load(self, grpc_server: GrpcServer, ready: Callable[[], None]) -> None:
        await self._service.start()
        await grpc_server.set_serving(True)
        ready()

    def _http_server(self) -> "_HttpServer":
        config = uvicorn.Config(
            create_app(self._service, self._settings.max_body_bytes),
            log_config=None,
            access_log=False,
            lifespan="off",
            ws="none",
            server_header=False,
            timeout_graceful_shutdown=max(1, round(self._settings.grace_seconds)),
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
    logging.basicConfig(
        level=settings.log_level.upper(),
        stream=sys.stderr,
        format="%(asctime)s %(levelname)s %(name)s: %(message)s",
    )
    logging.getLogger("uvicorn").setLevel(logging.WARNING)
    asyncio.run(_serve_until_signalled(Server(settings)))


async def _serve_until_signalled(server: Server) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)

    def opened() -> None:
        logger.info("opened %s and gRPC %s, loading", server.http_url, server.grpc_address)

    def ready() -> None:
        sys.stdout.write(f"EdgeGrasp serves HTTP {server.http_url} gRPC {server.grpc_address}\n")
        sys.stdout.flush()

    await server.serve(stop, opened, ready)


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
