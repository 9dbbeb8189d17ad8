"""Reload: new weights, tokens and certificates in the place of the old ones, or why not."""

import asyncio
import logging
from collections.abc import Callable

from edgegrasp_model.errors import EdgeGraspError
from edgegrasp_service.call import Call
from edgegrasp_service.errors import PermissionDenied, ReloadFailed
from edgegrasp_service.front.service import GraspService, ModelInfo
from edgegrasp_service.security import ADMIN_FIX, HEADER, ServerTls, Tokens

logger = logging.getLogger(__name__)


class Reloader:
    """Reloads one server, one reload after the other.

    Args:
        service: Whose weights and tokens are loaded beside the old ones, which serve meanwhile.
        read_tokens: Reads them.
        tls: Whose certificates are read anew; None: there are none.
        reloaded: Told of each reload whether it succeeded.
    """

    def __init__(
        self,
        service: GraspService,
        read_tokens: Callable[[], Tokens],
        tls: ServerTls | None,
        reloaded: Callable[[bool], None],
    ) -> None:
        self._service = service
        self._read_tokens = read_tokens
        self._tls = tls
        self._reloaded = reloaded
        self._turn = asyncio.Lock()
        self._waiting = False
        self._tasks: set[asyncio.Task[None]] = set()

    async def reload(self, call: Call) -> list[ModelInfo]:
        """Load weights, tokens and certificates anew, for a caller with an admin token.

        Returns:
            What is loaded now.

        Raises:
            PermissionDenied: The caller has none.
            NotReady: The first weights are still loading, or the server is stopping.
            ReloadFailed: Something cannot be used, and all is as before; or a reload waits already.
        """
        if not call.is_admin:
            raise PermissionDenied(HEADER, "a call for administrators", ADMIN_FIX)
        return await self._in_turn()

    def reload_soon(self) -> None:
        """Begin a reload in the running event loop; what comes of it is in the log."""
        task = asyncio.get_running_loop().create_task(self._reload_quietly())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _reload_quietly(self) -> None:
        try:
            await self._in_turn()
        except EdgeGraspError as error:
            logger.warning("SIGHUP: %s", error)

    async def _in_turn(self) -> list[ModelInfo]:
        self._service.check_ready()
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
            await self._service.pool.reload()
        except EdgeGraspError as error:
            self._reloaded(False)
            logger.error("reload failed, the old weights still serve: %s", error)
            raise ReloadFailed(f"The old weights still serve. {error}") from None
        except Exception:
            self._reloaded(False)
            logger.exception("reload failed, the old weights still serve")
            raise ReloadFailed("The old weights still serve; the log says why.") from None
        self._service.tokens = tokens
        if self._tls is not None and certificates is not None:
            self._tls.use(certificates)
        self._reloaded(True)
        models = self._service.models()
        digests = {model.name: model.digest for model in models}
        logger.info("reloaded", extra={"fields": {"digests": digests}})
        return models
