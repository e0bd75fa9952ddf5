"""The line to one page: what it asks for is done and answered, and whatever is new is sent to it.

Messages are JSON, or binary: the length of a JSON header in four bytes, the header, and a picture or numbers.
"""

from __future__ import annotations

import asyncio
import json
import struct
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any

import torch
from starlette.websockets import WebSocket, WebSocketDisconnect

from torch_ecc.io.summary import plain
from torch_ecc.view.desk import FALLEN, Desk
from torch_ecc.view.history import History
from torch_ecc.view.pictures import LIVE_SIDE, jpeg
from torch_ecc.view.run import Run

BUSY, IDLE = 0.05, 0.2  # s between looks at what there is to send
SHARE = 2.0  # of the time from picture to picture to that of making and showing one: tracking goes before
TELLING = 0.5  # s between words on how late poses are, which all are counted for
ACTIONS = (
    *("mark", "outline", "rois", "grid", "best", "undo", "redo", "predict"),
    *("set", "track", "stop", "row", "look"),
)
Ask = Callable[..., Awaitable[Any]]


class Link:
    """A page that looks at the desk. ``ask`` calls what works on the desk, one thing at a time.

    What is new of a run, rows and a picture, is sent once the page has shown what was sent before: it never lags
    behind, and on a computer that has no time to show pictures there are fewer of them.
    """

    def __init__(self, desk: Desk, socket: WebSocket, ask: Ask) -> None:
        self.desk, self.socket, self.ask = desk, socket, ask
        self._told: object = None
        self._history: History | None = None
        self._rows, self._frame, self._side = 0, -1, LIVE_SIDE
        self._shown, self._begun, self._rest, self._tell = True, 0.0, 0.0, 0.0
        self._sending = asyncio.Lock()
        self._actions: dict[str, Callable[..., Any]] = {name: getattr(desk, name) for name in ACTIONS}

    async def serve(self) -> None:
        """Until the page is closed."""
        sender = asyncio.create_task(self._send_news())
        try:
            while True:
                await self._receive(await self.socket.receive_json())
        except (WebSocketDisconnect, json.JSONDecodeError):
            pass
        finally:
            sender.cancel()

    async def _receive(self, message: dict[str, Any]) -> None:
        """Do what the page asks for, and answer."""
        do, given = message.get("do"), message.get("with") or {}
        if do == "shown":
            self._note_shown(**given)
            return
        answer: dict[str, Any] = {"is": "answer", "id": message.get("id")}
        try:
            if do == "map":
                await self._send_map(answer, **given)
                return
            found = await self.ask(self._actions[str(do)], **given)
            answer["value"] = found._asdict() if hasattr(found, "_asdict") else found
        except FALLEN as error:
            answer["error"] = str(error)
        except (KeyError, TypeError) as error:
            answer["error"] = f"The page asked for something unknown: {error}"
        await self._send_state()
        await self._send(answer)

    def _note_shown(self, side: int = LIVE_SIDE) -> None:
        """The page has drawn what was sent, in a picture with sides of at most ``side`` px."""
        now = time.perf_counter()
        self._shown, self._side = True, max(min(int(side), LIVE_SIDE), 1)
        self._rest = now + (SHARE - 1) * (now - self._begun)

    async def _send_news(self) -> None:
        with suppress(WebSocketDisconnect, RuntimeError):
            while True:
                await self._send_state()
                if self._shown and time.perf_counter() >= self._rest:
                    await self._send_run()
                await asyncio.sleep(BUSY if self.desk.running else IDLE)

    async def _send_state(self) -> None:
        desk = self.desk
        told = desk.version, desk.run, desk.run and desk.run.state
        if told != self._told:
            self._told = told
            await self._send({"is": "state", "state": plain(desk.told())})

    async def _send_run(self) -> None:
        """What is new of it, and the question to tell when that is shown."""
        self._begun = time.perf_counter()
        if [await self._send_rows(), await self._send_picture()] != [False, False]:
            self._shown = False
            await self._send({"is": "all"})

    async def _send_rows(self) -> bool:
        history, run = self.desk.rows, self.desk.run
        if history is None:
            return False
        new, self._rows = history is not self._history, 0 if history is not self._history else self._rows
        self._history, count = history, len(history)
        if not new and count == self._rows:
            return False
        rows, self._rows = history.since(self._rows), count
        head = {"is": "rows", "new": new, "width": rows.shape[1], "start": plain(history.start.tolist())}
        await self._send(head | {"run": self._run_told(run)}, rows.tobytes())
        return True

    def _run_told(self, run: Run | None) -> dict[str, Any] | None:
        """All of it from time to time, and else what is told without looking at all that was."""
        if run is None or self._begun < self._tell:
            return None if run is None else plain(run.counted())
        self._tell = self._begun + TELLING
        found: dict[str, Any] = plain(run.told())
        return found

    async def _send_picture(self) -> bool:
        frame = self.desk.run.frame if self.desk.run is not None else None
        if frame is None or frame.number == self._frame:
            return False
        self._frame = frame.number
        row = None if self._history is None else self._history.at(frame.number)
        data = await asyncio.to_thread(jpeg, frame, self.desk.stretch, self._side)
        await self._send({"is": "picture", "row": None if row is None else plain(row.tolist())}, data)
        return True

    async def _send_map(self, answer: dict[str, Any], size: int) -> None:
        found = await self.ask(self.desk.map, size)
        head = {
            "rows": len(found.y),
            "columns": len(found.x),
            "x": found.x[[0, -1]].tolist(),
            "y": found.y[[0, -1]].tolist(),
        }
        await self._send(answer | {"value": head}, found.worst.to(torch.float64).numpy().tobytes())

    async def _send(self, message: dict[str, Any], data: bytes | None = None) -> None:
        """One at a time: the answers and the news come from two tasks."""
        async with self._sending:
            if data is None:
                await self.socket.send_text(json.dumps(message))
                return
            head = json.dumps(message).encode()
            head += b" " * (-(4 + len(head)) % 8)  # what comes after may be numbers of 8 bytes
            await self.socket.send_bytes(struct.pack("<I", len(head)) + head + data)
