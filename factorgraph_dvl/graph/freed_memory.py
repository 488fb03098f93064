"""Memory of small blocks that were freed: given back to the system."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache


def return_freed() -> None:
    """Give freed memory back to the system where the C library keeps it.

    That of GNU keeps small blocks, such as those of GTSAM's factors, for what is to come. NumPy's
    arrays do not fit there. Measured: 250 MB after a test of all known parameters of a trial of
    4800 s, of 800 MB in all.
    """
    trim = _trim()
    if trim is not None:
        trim(0)


@lru_cache(maxsize=1)
def _trim() -> Callable[[int], int] | None:
    """Return the C library's function, None if it has none."""
    try:
        found: Callable[[int], int] = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):
        return None
    return found
