"""The station's WebSocket: states for every page, and the actions of the page that operates."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from tagid.errors import UsageError
from tagid.station import wire
from tagid.station.errors import BusyError
from tagid.station.requests import Body, json_object, refusal_of, refused
from tagid.station.station import MAX_CONNECTIONS, Station

FRAME_S = 0.1
_STATUS_S = 1.0
_SEND_S = 10.0
"""Time after which a client that does not accept a frame is disconnected, s."""


class Hub:
    """Sends new states to every connection; each has at most one unsent frame and one unsent status."""

    def __init__(self, station: Station) -> None:
        self._station = station
        self._clients: set[Client] = set()
        self._seen: dict[str, tuple[object, ...]] = {}

    def add(self, client: Client) -> None:
        """Send the complete state to a new connection."""
        self._clients.add(client)
        self._post(client, "status", wire.to_text(wire.status(self._station)))
        if (run := self._station.scan) is not None:
            self._post(client, "frame", wire.to_text(wire.frame(run)))

    def remove(self, client: Client) -> None:
        self._clients.discard(client)

    def refresh(self) -> None:
        """Send the status to all now."""
        self._send_all("status", wire.status(self._station))

    async def run(self) -> None:
        """Poll for new states until cancelled."""
        station, status_at = self._station, 0.0
        while True:
            await asyncio.sleep(FRAME_S)
            station.tick()
            run, now = station.scan, asyncio.get_running_loop().time()
            new = run is not None and self._changed("frame", run.number, run.view.state.frame, run.running)
            if run is not None and new and self._clients:
                self._send_all("frame", wire.frame(run))
            report = station.reports.newest
            done = None if report is None else (report.number, report.done, report.running)
            running = run is not None and run.running
            if self._changed("status", station.enrolling.state, done, running) or now >= status_at:
                status_at = now + _STATUS_S
                self.refresh()
            profile, step = station.profile, station.commissioning
            if profile is not None and self._changed("profile", profile, profile.profile, profile.running):
                self._send_all("profile", {"type": "profile", **wire.profile(profile)})
            if step is not None and self._changed("commissioning", step, step.progress, step.running):
                self._send_all("commissioning", {"type": "commissioning", **wire.step_progress(step)})

    def _changed(self, kind: str, *state: object) -> bool:
        """Whether the state of a kind of message is another than at the last call."""
        before, self._seen[kind] = self._seen.get(kind), state
        return before != state

    def _send_all(self, kind: str, message: wire.Json) -> None:
        text = wire.to_text(message)
        for client in self._clients:
            self._post(client, kind, text)

    @staticmethod
    def _post(client: Client, kind: str, text: str) -> None:
        client.unsent[kind] = text
        client.news.set()


@dataclass(eq=False)
class Client:
    """One WebSocket connection.

    Attributes:
        key: of its operator's lock.
        unsent: the newest unsent text of each kind; `news` is set when there is one.
    """

    key: str
    unsent: dict[str, str] = field(default_factory=dict)
    news: asyncio.Event = field(default_factory=asyncio.Event)


class LiveSocket:
    def __init__(self, station: Station, hub: Hub) -> None:
        self._station, self._hub = station, hub
        self._open = 0

    async def serve(self, socket: WebSocket) -> None:
        if self._open >= MAX_CONNECTIONS:
            full = f"{MAX_CONNECTIONS} pages are connected to the station"
            refusal = refused(503, "too_many_connections", full, "Close one of them.")
            await socket.send_denial_response(refusal)
            return
        self._open += 1
        try:
            await socket.accept()
            await self._serve(socket)
        finally:
            self._open -= 1

    async def _serve(self, socket: WebSocket) -> None:
        operators = self._station.operators
        connected = socket.scope["state"]["connected"]
        try:
            key = operators.join(await _hello(socket), connected)
        except (WebSocketDisconnect, _BadMessageError, TimeoutError):
            await _close(socket, 1008)
            return
        client = Client(key)
        client.unsent["hello"] = wire.to_text(wire.hello(self._station, key))
        self._hub.add(client)
        tasks = [
            asyncio.create_task(self._send(socket, client)),
            asyncio.create_task(self._receive(socket, client)),
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._hub.remove(client)
            operators.leave(key, connected)
            for task in tasks:
                task.cancel()
            done = await asyncio.gather(*tasks, return_exceptions=True)
            bad = any(isinstance(result, _BadMessageError) for result in done)
            await _close(socket, 1008 if bad else 1011)

    async def _send(self, socket: WebSocket, client: Client) -> None:
        mine: bool | None = None
        while True:
            await client.news.wait()
            client.news.clear()
            holds = self._station.operators.holds(client.key)
            if holds != mine:
                mine = holds
                client.unsent["operator"] = wire.to_text({"type": "operator", "you": holds})
            while client.unsent:
                kind = next(iter(client.unsent))
                text = client.unsent.pop(kind)
                # Not wait_for: before Python 3.12 it swallows a cancellation when the send is just done.
                async with asyncio.timeout(_SEND_S):
                    await socket.send_text(text)

    async def _receive(self, socket: WebSocket, client: Client) -> None:
        while True:
            await self._act(client, _message(await socket.receive()))

    async def _act(self, client: Client, message: Body) -> None:
        """Execute a message; a refusal is reported to its sender."""
        station, kind = self._station, message.get("type")
        try:
            if kind == "scan":
                note, demo_object = message.get("note", ""), message.get("object", "")
                if not (isinstance(note, str) and isinstance(demo_object, str)):
                    raise _BadMessageError
                await run_in_threadpool(station.start, client.key, note, demo_object)
            elif kind == "stop":
                station.stop()
            elif kind == "take":
                if not station.take_over(client.key):
                    raise BusyError("another browser operates the scan that is running", "Wait for its end.")
            elif kind == "release":
                station.release(client.key)
            else:
                raise _BadMessageError
        except _BadMessageError:
            raise
        except Exception as error:
            refusal = refusal_of(error, "live")
            client.unsent["error"] = wire.to_text({"type": "error", "error": refusal.entry})
        self._hub.refresh()


class _BadMessageError(Exception):
    """A client sent an invalid message."""


async def _hello(socket: WebSocket) -> str | None:
    """The key in the first message of a connection. Raises _BadMessageError, TimeoutError."""
    async with asyncio.timeout(_SEND_S):
        message = _message(await socket.receive())
    key = message.get("key")
    if message.get("type") != "hello" or not (key is None or isinstance(key, str)):
        raise _BadMessageError
    return key


def _message(received: Mapping[str, Any]) -> Body:
    """The JSON object of a text frame. Raises _BadMessageError, WebSocketDisconnect."""
    if received["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(received.get("code", 1005))
    try:
        return json_object(received.get("text") or "")
    except UsageError:
        raise _BadMessageError from None


async def _close(socket: WebSocket, code: int) -> None:
    if socket.application_state is WebSocketState.CONNECTED:
        with suppress(Exception):
            async with asyncio.timeout(1.0):
                await socket.close(code)
