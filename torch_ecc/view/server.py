"""The page's server: on this machine alone, for whoever has its address with the token, and for no other page."""

from __future__ import annotations

import asyncio
import secrets
import socket
import tempfile
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket

from torch_ecc.view.desk import FALLEN, Desk
from torch_ecc.view.link import Link

HOST = "127.0.0.1"
PAGE = Path(__file__).parent / "page"
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Guard:
    """Lets through what comes from this machine's own page: its host, its origin, and the token in its path."""

    def __init__(self, app: ASGIApp, port: int, token: str) -> None:
        self.app, self.token = app, token
        self.hosts = {f"{name}:{port}" for name in (HOST, "localhost")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            return await self.app(scope, receive, send)
        why = self._refusal(scope)
        if why is None:
            return await self.app(scope, receive, send)
        if scope["type"] == "websocket":
            return await send({"type": "websocket.close", "code": 1008, "reason": why})
        return await PlainTextResponse(f"{why}\n", 403)(scope, receive, send)

    def _refusal(self, scope: Scope) -> str | None:
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        if headers.get("host") not in self.hosts:
            return "Refused: this page is served under 127.0.0.1 alone."
        if (origin := headers.get("origin")) is not None and origin not in {f"http://{host}" for host in self.hosts}:
            return "Refused: another page asks."
        if not secrets.compare_digest(scope["path"].split("/")[1].encode(), self.token.encode()):
            return "Refused: the token is missing. Open the whole address that torch-ecc pick has printed."
        return None


class Server:
    """Serves a desk. ``url`` is the address with the token."""

    def __init__(self, desk: Desk, port: int = 0) -> None:
        self.desk, self.token = desk, secrets.token_urlsafe(24)
        self.worker = ThreadPoolExecutor(1, "desk", torch.set_num_threads, (1,))  # one thing at a time on the desk
        self.socket = socket.create_server((HOST, port))
        self.port = self.socket.getsockname()[1]
        self.url = f"http://{HOST}:{self.port}/{self.token}/"
        routes = [
            Route("/", self._index),
            Route("/frame/{number:int}.jpg", self._frame),
            Route("/files/{name}", self._file),
            WebSocketRoute("/link", self._link),
            Mount("/page", StaticFiles(directory=PAGE)),
        ]
        self.app = Guard(Starlette(routes=[Mount(f"/{self.token}", routes=routes)]), self.port, self.token)

    def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Serve until Ctrl-C; a run that goes on is stopped then, and keeps what it had: see the desk's ``run``."""
        import uvicorn

        config = uvicorn.Config(self.app, log_level="warning", lifespan="off", timeout_graceful_shutdown=1)
        server = uvicorn.Server(config)
        ready()
        with suppress(KeyboardInterrupt):
            server.run(sockets=[self.socket])
        self.worker.shutdown(cancel_futures=True)
        self.desk.stop()

    async def _ask(self, call: Callable[..., Any], *args: Any, **options: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self.worker, lambda: call(*args, **options))

    async def _index(self, request: Request) -> Response:
        return FileResponse(PAGE / "index.html", headers=HEADERS)

    async def _frame(self, request: Request) -> Response:
        try:
            data = await self._ask(self.desk.picture, request.path_params["number"])
        except FALLEN as error:
            return PlainTextResponse(str(error), 422, headers=HEADERS)
        return Response(data, media_type="image/jpeg", headers=HEADERS)

    async def _file(self, request: Request) -> Response:
        name, told = request.path_params["name"], self.desk.told()
        folder, names = Path(told["folder"]), told["files"]
        if name == "all.zip" and names:
            packed = await self._ask(_packed, folder, names)
            leave = BackgroundTask(packed.unlink)
            return FileResponse(packed, filename=f"{folder.name}.zip", headers=HEADERS, background=leave)
        if name not in names:
            return PlainTextResponse(f"There is no {name}.", 404, headers=HEADERS)
        return FileResponse(folder / name, filename=name, headers=HEADERS)

    async def _link(self, socket: WebSocket) -> None:
        await socket.accept()
        await Link(self.desk, socket, self._ask).serve()


def _packed(folder: Path, names: list[str]) -> Path:
    """The files in one: a new file, to be removed by whoever asked."""
    with tempfile.NamedTemporaryFile(suffix=".zip", delete=False) as file, zipfile.ZipFile(file, "w") as archive:
        for name in names:
            archive.write(folder / name, name)
    return Path(file.name)
