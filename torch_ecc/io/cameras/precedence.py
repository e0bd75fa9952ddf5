"""A thread that frames wait for goes before those that can wait themselves: pictures, files, a browser."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress


@contextmanager
def before_others() -> Iterator[None]:
    """The calling thread, where Linux allows it (root, or an rtprio in limits.conf) and another processor is left.

    Threads that it begins are as all others are.
    """
    if not _raised():
        yield
        return
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))


def _raised() -> bool:
    """Whether that was allowed."""
    if not hasattr(os, "SCHED_RR") or len(os.sched_getaffinity(0)) < 2:
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except OSError:
        return False
    return True
