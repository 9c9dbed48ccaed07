"""Memory that is used again instead of being asked for again."""

import ctypes

# Of glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
_MOST = 2**31 - 1


def keep_freed_memory() -> bool:
    """Let the C library keep what XLA frees, up to 2 GiB, for the next call; True if it will.

    XLA on a CPU allocates its temporary arrays anew for each call. glibc gives blocks of that size
    back to the system at once, which clears each page again before it is next written to: a third
    of the time of an image's gradient. For whole programs, not for libraries.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, TypeError, AttributeError):
        return False
    return bool(mallopt(_MMAP_MAX, 0) and mallopt(_TRIM_THRESHOLD, _MOST))
