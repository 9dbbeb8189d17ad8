"""Memory that a request frees is there for the next one."""

import platform
import subprocess
import sys

import pytest

# Page faults while some blocks of the size of a cloud are taken, filled and freed, many times.
PROGRAM = """
import resource
from edgegrasp_service.allocator import keep_freed_memory

KEEP

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def request():
    return [bytearray(b"x") * size for size in (240_000, 300_000, 360_000, 420_000, 1_000_000)]

for _ in range(3):
    request()
before = faults()
for _ in range(50):
    request()
print(faults() - before)
"""


def _faults(keep: str) -> int:
    program = PROGRAM.replace("KEEP", keep)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_blocks_of_a_request_are_taken_from_the_kernel_once() -> None:
    assert _faults("keep_freed_memory()") < 500
    assert _faults("") > 5_000  # or there would be nothing to keep
