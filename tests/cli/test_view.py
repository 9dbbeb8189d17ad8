"""`edgegrasp view`."""

import signal
import subprocess
from pathlib import Path

import httpx
import numpy as np
import pytest
from tests.programs import EDGEGRASP


def test_a_scene_is_served_until_ctrl_c(tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", np.full((4, 6), 500, np.uint16))
    flags = ("--depth", tmp_path / "depth.npy", "--intrinsics", "30,30,3,2", "--no-browser")
    command = [*EDGEGRASP, "view", *map(str, flags)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as viewer:
        assert viewer.stdout is not None
        address = viewer.stdout.readline().split()[0]
        try:
            sample = httpx.get(f"{address}samples/samples.json").json()[0]
            assert sample["intrinsics"] == "30,30,3,2"
            file = httpx.get(f"{address}samples/{sample['files'][0]}").content
            assert file == (tmp_path / "depth.npy").read_bytes()
            assert httpx.get(address).status_code == 200
        finally:
            viewer.send_signal(signal.SIGINT)
        assert viewer.wait(timeout=30) == 0
    with pytest.raises(httpx.ConnectError):
        httpx.get(address)


def test_a_file_that_is_not_there_is_named(refused) -> None:
    assert "No such file" in refused("view", "absent.ply", "--no-browser")
