"""Access control: checks every request and WebSocket before it reaches the application.

Threats and countermeasures: another web page in the same browser (Origin, Sec-Fetch-Site, a header that forms
cannot send), DNS rebinding (Host), a device in the network (pairing), a script in a name (content policy),
large or malformed bodies (limits).
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import secrets
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from tagid.errors import UsageError
from tagid.result import Problem
from tagid.station.errors import GuessesError

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_SCRIPTS = ("theme", "station", "pictures", "enrol", "history", "settings", "profile", "drop", "commission")
PAGE_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/station.css": ("station.css", "text/css; charset=utf-8"),
    "/station.svg": ("station.svg", "image/svg+xml"),
    **{f"/{name}.js": (f"{name}.js", "text/javascript; charset=utf-8") for name in _SCRIPTS},
}
"""Path of a request -> file of the page and its media type; no file path is derived from a request."""
COOKIE = "tagid_station"
OWN_HEADER = "tagid-station"
"""Sent with each POST and by WebSocket clients other than browsers: another page cannot send it without a
CORS preflight request, which is never allowed."""
MOST_BODY_BYTES = 4096
MOST_UPLOAD_BYTES = 64 << 20
"""Largest capture that the station accepts; a scan of a turn takes up to 50 MB."""
_CODE_LETTERS = "23456789ABCDEFGHJKMNPQRSTUVWXYZ"
_CODE_SECONDS = 600.0
_MOST_WAITING = 100
"""Codes of one address that may wait to be compared."""
_MOST_TOKENS = 32
_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
UPLOAD_PATH = "/api/v1/captures"
"""The only path whose body is a file; its name and the operator's key are headers."""
NAME_HEADER = "tagid-file-name"
KEY_HEADER = "tagid-key"
_OPEN_PATHS = (*PAGE_FILES, "/api/v1/pair", "/api/v1/openapi.json")
"""Paths that need no token, because they reveal nothing about the station."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_POLICY_HEADER = (b"content-security-policy", POLICY.encode())
_HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)


class Pairing:
    """The pairing code, and the tokens created with it.

    A code creates one token and is valid for ten minutes; then a new one is announced. A wrong code changes
    nothing, or a stranger could keep others out; `Guesses` limits how many are compared.

    Args:
        announce: shows a new code at the computer.
        clock: monotonic seconds.
    """

    def __init__(self, announce: Callable[[str], None], clock: Callable[[], float] = time.monotonic) -> None:
        self._announce = announce
        self._clock = clock
        self._tokens: list[bytes] = []
        self._code, self._until = "", 0.0

    def begin(self) -> None:
        """Announce a new code."""
        letters = [secrets.choice(_CODE_LETTERS) for _ in range(8)]
        self._code = "".join(letters[:4]) + "-" + "".join(letters[4:])
        self._until = self._clock() + _CODE_SECONDS
        self._announce(self._code)

    def pair(self, code: str) -> str | None:
        """A token for a code; None if it is wrong or expired."""
        late = self._clock() > self._until
        given = code.strip().upper().encode()
        right = hmac.compare_digest(given, self._code.encode()) and not late
        if not right:
            if late:
                self.begin()
            return None
        token = self._grant()
        self.begin()
        return token

    def _grant(self) -> str:
        token = secrets.token_urlsafe(32)
        self._tokens = [*self._tokens, _digest(token)][-_MOST_TOKENS:]
        return token

    def knows(self, token: str) -> bool:
        digest = _digest(token)
        return any(hmac.compare_digest(digest, token) for token in self._tokens)


@dataclass
class _Queue:
    """Codes of one address: the lock of the next one, and how many wait."""

    turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    waiting: int = 0


class Guesses:
    """Has pairing codes compared one after the other, each address in its turn, whatever their number."""

    def __init__(self) -> None:
        self._turn = asyncio.Lock()
        self._queues: dict[str, _Queue] = {}

    @asynccontextmanager
    async def turn(self, address: str) -> AsyncIterator[None]:
        """The time to compare a code; the next one waits for its end. Raises GuessesError."""
        queue = self._queues.setdefault(address, _Queue())
        if queue.waiting >= _MOST_WAITING:
            raise GuessesError("too many pairing codes wait", "Wait a few seconds.")
        queue.waiting += 1
        try:
            async with queue.turn, self._turn:
                yield
        finally:
            queue.waiting -= 1
            if not queue.waiting:
                del self._queues[address]


def _digest(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "replace")).digest()


@dataclass(frozen=True)
class Refusal:
    """Reason for refusing a request: an HTTP status, and the rest as in every error of the API."""

    status: int
    code: str
    message: str
    remedy: str

    @property
    def entry(self) -> dict[str, str]:
        """The error as in every answer of the API."""
        return Problem(self.code, self.message, self.remedy).to_json()


class Guard:
    """ASGI middleware: refuses disallowed requests, and adds the security headers to every response.

    It knows the address that it listens on. Without pairing, on a loopback address, no token is required.
    """

    def __init__(self, app: ASGIApp, host: str, port: int, pairing: Pairing | None) -> None:
        self._app = app
        self._pairing = pairing
        names = {*_LOOPBACK, host if ":" not in host else f"[{host}]"}
        self._hosts = {f"{name}:{port}" for name in names}
        if port == 80:
            self._hosts |= names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope)
        if refusal is None:
            scope["state"]["paired"] = self._pairing is not None and scope["path"] not in _OPEN_PATHS
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": refusal.code})
        else:
            body = json.dumps({"error": refusal.entry}).encode()
            headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
            # The rest of the body is not read: the connection ends with the response.
            start = {
                "type": "http.response.start",
                "status": refusal.status,
                "headers": [*headers, (b"connection", b"close")],
            }
            answer = _with_headers(send)
            await answer(start)
            await answer({"type": "http.response.body", "body": body})

    def _refusal(self, scope: Scope) -> Refusal | None:
        headers: dict[str, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
        hosts = headers.get("host", [])
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return Refusal(
                421, "wrong_host", "this is not an address of the station", "Use the address it printed."
            )
        path: str = scope["path"]
        socket = scope["type"] == "websocket"
        page = not socket and path == "/" and scope["method"] == "GET"
        origins = headers.get("origin", [])
        own_page = headers.get(OWN_HEADER) == ["1"]
        foreign = any(origin.lower() != f"http://{hosts[0].lower()}" for origin in origins)
        site = headers.get("sec-fetch-site", ["none"])
        if foreign or (site not in (["same-origin"], ["none"]) and not page):
            return Refusal(
                403, "wrong_origin", "another page sent this request", "Open the station's own page."
            )
        if socket:
            if not origins and not own_page:
                return Refusal(
                    403, "no_origin", "this request was not sent by a page", f"Scripts send {OWN_HEADER}: 1."
                )
        elif refusal := _of_body(scope["method"], path, headers, own_page):
            return refusal
        if self._pairing is not None and path not in _OPEN_PATHS and not self._paired(headers):
            return Refusal(
                401,
                "not_paired",
                "this device is not paired",
                "Enter the pairing code that the station printed.",
            )
        return None

    def _paired(self, headers: dict[str, list[str]]) -> bool:
        tokens = [value[7:] for value in headers.get("authorization", []) if value.startswith("Bearer ")]
        for line in headers.get("cookie", []):
            for part in line.split(";"):
                name, _, value = part.strip().partition("=")
                if name == COOKIE:
                    tokens.append(value)
        return any(self._pairing is not None and self._pairing.knows(token) for token in tokens[:4])


def _of_body(method: str, path: str, headers: dict[str, list[str]], own_page: bool) -> Refusal | None:
    """Reason for refusing a request's method or body."""
    upload = method == "POST" and path == UPLOAD_PATH
    most = MOST_UPLOAD_BYTES if upload else MOST_BODY_BYTES if method == "POST" else 0
    media = "application/octet-stream" if upload else "application/json"
    length = headers.get("content-length", ["0"])
    if method not in ("GET", "HEAD", "POST"):
        return Refusal(405, "method", f"{method[:20]} is not a supported method", "Use GET or POST.")
    if "transfer-encoding" in headers or len(length) != 1 or not length[0].isdecimal():
        return Refusal(411, "length", "the length of the body is unknown", "Send Content-Length.")
    if len(length[0]) > 9 or int(length[0]) > most:
        return Refusal(413, "too_large", "the body is too large", f"Send at most {most} bytes here.")
    if method != "POST":
        return None
    if headers.get("content-type", [""])[0].partition(";")[0].strip().lower() != media:
        code = "wrong_type" if upload else "not_json"
        return Refusal(415, code, f"the body is not {media}", f"Send Content-Type: {media}.")
    if not own_page:
        return Refusal(403, "no_header", f"the header {OWN_HEADER} is missing", f"Send {OWN_HEADER}: 1.")
    return None


def _with_headers(send: Send) -> Send:
    """The same, with the security headers on every response; one may have a content policy of its own."""

    async def answer(message: Message) -> None:
        if message["type"] in ("http.response.start", "websocket.http.response.start"):
            headers = list(message.get("headers", ()))
            if not any(name.lower() == _POLICY_HEADER[0] for name, _ in headers):
                headers.append(_POLICY_HEADER)
            message = {**message, "headers": [*headers, *_HEADERS]}
        await send(message)

    return answer


def is_loopback(host: str) -> bool:
    """Whether an address is reachable from this computer only.

    >>> is_loopback("127.0.0.1"), is_loopback("localhost"), is_loopback("0.0.0.0")
    (True, True, False)

    Raises UsageError for an invalid address.
    """
    import ipaddress

    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise UsageError(f"the address is {host[:100]!r}", "Give an IP address, e.g. 127.0.0.1.") from None
