"""The page: mark patches in a browser, see how well each can be tracked, track, watch, and look at results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any


def serve(values: Mapping[str, Any], port: int, *, show: Callable[[str], None]) -> list[str]:
    """Serve the page of a job with these ``values`` until Ctrl-C; ``show`` is told its address. Sentences about the run
    that this has stopped, if it has. ValueError if what serves pages is not installed."""
    try:
        from torch_ecc.view.server import Server
    except ModuleNotFoundError as error:
        library = str(error.name).split(".")[0]
        raise ValueError(f"pick: the page needs {library}: pip install 'torch-ecc[view]'") from error
    from torch_ecc.view.desk import Desk

    server = Server(Desk(values), port)
    server.run(ready=lambda: show(server.url))
    run = server.desk.run
    return run.words if run is not None and run.state == "stopped" else []
