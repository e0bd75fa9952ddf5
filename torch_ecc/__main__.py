"""``torch-ecc`` and ``python -m torch_ecc``: the command line, and what may happen before it is there."""

from __future__ import annotations

import gc
import os
import signal

INTERRUPTED = 130
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
    finally:
        gc.freeze()  # nor is what is there at the end


if __name__ == "__main__":
    main()
