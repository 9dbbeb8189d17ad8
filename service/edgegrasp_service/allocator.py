"""The C library's allocator: what a request frees is kept for the next one."""

import ctypes

# Parameters of mallopt(3).
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3

LARGE_BYTES = 4 * 2**20  # larger blocks go back to the kernel as soon as they are freed
KEPT_BYTES = 16 * 2**20  # free at an arena's end, before any of it goes back


def keep_freed_memory() -> None:
    """Keep what messages, clouds and the arrays between stages took, for the whole process.

    By default glibc gives blocks above 128 KiB back at once. The kernel then zeroes every page
    anew for the next request: 0.4 ms for a message of 20,000 points. No effect without glibc.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except AttributeError:
        return
    mallopt(M_MMAP_THRESHOLD, LARGE_BYTES)
    mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
