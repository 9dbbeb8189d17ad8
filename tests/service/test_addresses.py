"""Where servers listen and clients look: sockets of a folder, several servers of one name."""

import asyncio
import tempfile

import numpy as np
import pytest

from edgegrasp_client import AsyncGraspClient
from edgegrasp_service.errors import AddressInUse
from edgegrasp_service.probe import is_ready


async def test_sockets_of_a_folder(serve, transport: str, cloud: np.ndarray) -> None:
    """As a controller on the same machine uses them; the folder's path is short, as it must be."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        for _ in range(2):  # again over the sockets that the first has left
            running = await serve(host=f"unix:{folder}")
            kind, name = ("unix", "grpc") if transport == "grpc" else ("http+unix", "http")
            assert running.address(transport) == f"{kind}:{folder}/{name}.sock"
            async with AsyncGraspClient(running.address(transport)) as client:
                assert len((await client.detect(cloud, timeout=20)).grasps) == 10
            assert await asyncio.to_thread(is_ready, f"unix:{folder}")
            with pytest.raises(AddressInUse, match=r"http\.sock .*in use"):
                await serve(host=f"unix:{folder}")
            running.stop.set()
            await running.serving


async def test_a_name_with_several_addresses_has_all_of_them_asked(
    serve, cloud: np.ndarray
) -> None:
    servers = [await serve(), await serve()]
    name = "ipv4:" + ",".join(one.server.grpc_address for one in servers)
    async with AsyncGraspClient(name) as client:
        async with asyncio.timeout(20):
            while not all(one.calls for one in servers):
                await client.detect(cloud)
