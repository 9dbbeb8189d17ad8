"""Reload: new weights, tokens and certificates in the place of the old ones, or why not."""

import asyncio
import logging
from collections.abc import Callable

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.core import GraspService, ModelInfo
from edgegrasp_service.edge import Edge
from edgegrasp_service.errors import NotReady, PermissionDenied, ReloadFailed
from edgegrasp_service.tls import ServerTls
from edgegrasp_service.tokens import ADMIN_FIX, HEADER, IS_ADMIN, Tokens

logger = logging.getLogger(__name__)


class Reloader:
    """Reloads one server, one reload after the other.

    Args:
        service: Whose weights are loaded beside the old ones, which answer meanwhile.
        edge: Whose tokens are read anew.
        read_tokens: Reads them.
        tls: Whose certificates are read anew, where there are any.
    """

    def __init__(
        self,
        service: GraspService,
        edge: Edge,
        read_tokens: Callable[[], Tokens],
        tls: ServerTls | None = None,
    ) -> None:
        self._service = service
        self._edge = edge
        self._read_tokens = read_tokens
        self._tls = tls
        self._turn = asyncio.Lock()
        self._waiting = False
        self._tasks: set[asyncio.Task[None]] = set()

    async def reload(self) -> list[ModelInfo]:
        """Load weights, tokens and certificates anew.

        Returns:
            What is loaded now.

        Raises:
            NotReady: The first weights are still loading, or the server is stopping.
            ReloadFailed: Something cannot be used, and all is as before; or a reload waits already.
        """
        if not self._service.ready:
            raise NotReady("Weights are still loading, or the server is stopping.")
        if self._waiting:
            raise ReloadFailed("A reload waits for another one already. Try again later.")
        self._waiting = self._turn.locked()
        try:
            await self._turn.acquire()
        finally:
            self._waiting = False
        try:
            return await self._reload()
        finally:
            self._turn.release()

    async def _reload(self) -> list[ModelInfo]:
        try:
            tokens = self._read_tokens()
            certificates = None if self._tls is None else self._tls.read()
            await self._service.reload()
        except EdgeGraspError as error:
            self._edge.metrics.reloaded(succeeded=False)
            logger.error("reload failed, the old weights still serve: %s", error)
            raise ReloadFailed(f"The old weights still serve. {error}") from None
        except Exception:
            self._edge.metrics.reloaded(succeeded=False)
            logger.exception("reload failed, the old weights still serve")
            raise ReloadFailed("The old weights still serve; the log says why.") from None
        self._edge.tokens = tokens
        if self._tls is not None and certificates is not None:
            self._tls.use(certificates)
        self._edge.metrics.reloaded(succeeded=True)
        models = self._service.models()
        digests = {model.name: model.digest for model in models}
        logger.info("reloaded", extra={"fields": {"digests": digests}})
        return models

    def reload_soon(self) -> None:
        """Begin a reload in the running event loop; what comes of it is in the log."""
        task = asyncio.get_running_loop().create_task(self._reload_quietly())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _reload_quietly(self) -> None:
        try:
            await self.reload()
        except EdgeGraspError as error:
            logger.warning("SIGHUP: %s", error)


async def reload_models(reloader: Reloader | None) -> list[ModelInfo]:
    """As `Reloader.reload`; raises PermissionDenied without one, or without an admin token."""
    if reloader is None or not IS_ADMIN.get():
        raise PermissionDenied(HEADER, "a call for administrators", ADMIN_FIX)
    return await reloader.reload()
