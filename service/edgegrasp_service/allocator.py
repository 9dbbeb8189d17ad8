"""The C library's allocator: what a request frees is kept for the next one."""

import ctypes

# Parameters of mallopt(3).
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3

LARGE_BYTES = 32 * 2**20  # larger blocks go back to the kernel as soon as they are freed
KEPT_BYTES = 64 * 2**20  # free at the end of an arena, before any of it goes back


def keep_freed_memory() -> None:
    """Keep what messages, clouds and the arrays between stages took, for the whole process.

    glibc comes to that by itself once a block as large was freed. A server of small clouds would
    map, zero and give back every message until then: 0.4 ms for 20,000 points. No effect without
    glibc.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:
        return
    mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)
    mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
