"""``torch-ecc`` and ``python -m torch_ecc``: the command line, and what may happen before it is there."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys

INTERRUPTED, UNSAID = 130, 120  # the second as Python ends where the screen is gone
ENDING = ("SIGINT", "SIGTERM", "SIGHUP")  # one like the other: what was done is kept


def main() -> None:
    """Entry point. While torch is being imported there is nothing to keep, and a signal ends it in silence."""
    numbers = [getattr(signal, name) for name in ENDING if hasattr(signal, name)]
    heeded = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]  # as under nohup
    for number in heeded:
        signal.signal(number, lambda *_: os._exit(INTERRUPTED))
    gc.disable()  # nothing of what is imported is garbage: to look for it takes a tenth of the time
    from torch_ecc.cli import main as command_line

    gc.freeze()
    gc.enable()
    for number in heeded:
        signal.signal(number, signal.default_int_handler)
    try:
        command_line()
    except SystemExit as ending:
        _end(ending.code)


def _end(code: object) -> None:
    """As Python does, but without taking all apart that is in memory: that takes 0.1 s, and the system does it, too."""
    status = code if isinstance(code, int) else int(code is not None)
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):
        status = status or UNSAID
    os._exit(status)


if __name__ == "__main__":
    main()
