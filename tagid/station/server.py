"""Runs the station's application on a socket, with limits on connections and buffers of clients."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.wsproto_impl import WSProtocol

from tagid.errors import PortInUseError, UsageError
from tagid.station.memory import return_large_blocks
from tagid.station.security import MOST_BODY_BYTES, Pairing
from tagid.station.station import Station
from tagid.station.web import build

MAX_SOCKETS = 256
"""Open connections, WebSockets included; for one more, that which has asked for nothing longest is closed."""
HEADER_S = 10.0
"""Time after which a connection without a complete request is closed, s."""
PING_S = 4.0
"""Interval of WebSocket pings, and the time limit for the reply, s."""
_UNSENT_BYTES = 1 << 20
"""Bytes that a WebSocket client may leave unread before it is disconnected."""
STALL_S = 20.0
"""Time after which a client that does not read its response is disconnected, s."""


class StationHttp(H11Protocol):
    """HTTP with limits on connections, on the arrival of a request, and on the reading of a response."""

    _stalled: asyncio.TimerHandle | None = None
    _waits_since = 0.0
    _aborted = False

    def connection_made(self, transport: Any) -> None:
        """Accept the connection, unless there are too many and each of them is served."""
        self._waits_since = self.loop.time()
        if len(self.connections) >= MAX_SOCKETS and not self._make_room():
            transport.abort()
            return
        super().connection_made(transport)
        self.loop.call_later(HEADER_S, self._expire, None)

    def _make_room(self) -> bool:
        """Close the connection that has waited longest for a request; False if none waits.

        Connections that ask for nothing, in whatever number, would otherwise keep others out for `HEADER_S`.
        """
        idle = [one for one in self.connections if isinstance(one, StationHttp) and one._idle]
        if not idle:
            return False
        # Those without any request first: a browser keeps its connection for the next one.
        oldest = min(idle, key=lambda one: (one.cycle is not None, one._waits_since))
        oldest._aborted = True
        oldest.transport.abort()
        return True

    @property
    def _idle(self) -> bool:
        """Whether it waits for a request."""
        return not self._aborted and (self.cycle is None or self.cycle.response_complete)

    def connection_lost(self, exc: Exception | None) -> None:
        """End the connection; one that was refused was never counted."""
        self._read_again()
        if self.transport is not None:
            super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Wait for a client that does not read, but not for ever: its file and its place are needed."""
        super().pause_writing()
        self._stalled = self.loop.call_later(STALL_S, self.transport.abort)

    def resume_writing(self) -> None:
        """The client reads again."""
        super().resume_writing()
        self._read_again()

    def _read_again(self) -> None:
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None

    def on_response_complete(self) -> None:
        """Wait for the next request as long as for the first."""
        super().on_response_complete()
        self._waits_since = self.loop.time()
        self.loop.call_later(HEADER_S, self._expire, self.cycle)

    def _expire(self, cycle: Any) -> None:
        """Close where no whole request came after the one of a cycle."""
        arriving = self.cycle is not None and self.cycle.more_body
        if self in self.connections and (self.cycle is cycle or arriving):
            self.transport.abort()


class StationSocket(WSProtocol):
    """WebSockets without compression; clients that do not read or reply are disconnected."""

    def keepalive_timeout(self) -> None:
        """Abort without reply to a ping: a regular close would wait for the client to read."""
        self.transport.abort()

    def handle_ping(self, event: Any) -> None:
        """Reply, unless the client does not read the replies."""
        if self.transport.get_write_buffer_size() > _UNSENT_BYTES:
            self.transport.abort()
        else:
            super().handle_ping(event)


class Server:
    """The server in a separate thread; use it as a context manager.

    Args:
        station: the station to serve.
        host, port: where to listen; port 0: any free port.
        announce: shows a pairing code; None on a loopback address.

    Attributes:
        url: address of the page.

    Raises:
        PortInUseError: another program listens there. UsageError: the address is not of this computer.
    """

    def __init__(
        self, station: Station, host: str, port: int, announce: Callable[[str], None] | None = None
    ) -> None:
        self._station = station
        self._socket = _listen(host, port)
        self.port: int = self._socket.getsockname()[1]
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self.port}"
        self._pairing = None if announce is None else Pairing(announce)
        config = uvicorn.Config(
            build(station, host, self.port, self._pairing),
            http=StationHttp,
            ws=StationSocket,
            ws_max_size=MOST_BODY_BYTES,
            ws_ping_interval=PING_S,
            ws_ping_timeout=PING_S,
            ws_per_message_deflate=False,
            h11_max_incomplete_event_size=16_384,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=2,
            log_config=None,
            log_level="critical",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            lifespan="on",
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._serve, name="station-web", daemon=True)

    def __enter__(self) -> Server:
        return_large_blocks()
        self._thread.start()
        if self._pairing is not None:
            self._pairing.begin()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def running(self) -> bool:
        """Whether it serves."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Stop scans, close all connections, and end the thread."""
        self._station.close()
        self._server.should_exit = True
        if self._thread.ident is not None:
            self._thread.join(10.0)
        self._socket.close()

    def _serve(self) -> None:
        asyncio.run(self._server.serve([self._socket]))


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    found = socket.socket(family, socket.SOCK_STREAM)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        found.bind((host, port))
        found.listen(128)
    except OSError as error:
        found.close()
        if isinstance(error, socket.gaierror):
            raise UsageError(f"{host} is not an address", "Give an IP address, e.g. 127.0.0.1.") from error
        raise PortInUseError(
            f"cannot listen on {host}:{port}: {error.strerror}",
            "End the other program, or choose another port with --bind HOST:PORT.",
        ) from error
    return found
