"""What the HTTP handlers share: bodies, query parameters, responses, and the status of every error."""

from __future__ import annotations

import json
import logging
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from starlette.convertors import Convertor, register_url_convertor
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from tagid.errors import DataError, FileFormatError, RegistryError, StorageError, TagidError, UsageError
from tagid.result import Problem
from tagid.station import wire
from tagid.station.errors import (
    BusyError,
    EnrolmentError,
    GuessesError,
    NoSuchItemError,
    NotOperatorError,
    UnexpectedError,
    reported,
)
from tagid.station.security import MOST_BODY_BYTES, Refusal
from tagid.station.station import HISTORY_LIMIT, Station
from tagid.storage.history import Filter

_MOST_DIGITS = 18
"""Digits of a number in a request: it fits into a 64-bit integer."""
_LOGGED = 200
"""Characters of a path in the log."""
STATUSES: tuple[tuple[type[TagidError], int], ...] = (
    (BusyError, 409),
    (EnrolmentError, 409),
    (NotOperatorError, 403),
    (NoSuchItemError, 404),
    (GuessesError, 429),
    (UsageError, 400),
    (RegistryError, 409),
    (DataError, 422),
    (FileFormatError, 422),
    (StorageError, 507),
    (TagidError, 503),
)
"""HTTP status of each class of errors; the first that fits. Any other exception is a fault of tagid: 500."""


class _Number(Convertor[int]):
    """A number in a path; longer ones are no address."""

    regex = f"[0-9]{{1,{_MOST_DIGITS}}}"

    def convert(self, value: str) -> int:
        return int(value)

    def to_string(self, value: int) -> str:
        return str(value)


register_url_convertor("number", _Number())


Body = Mapping[str, object]
"""A JSON object that a client sent: whoever reads a value of it must see first what it is."""


async def body(request: Request) -> Body:
    """The JSON object of a request; empty without a body. Raises UsageError."""
    content = b""
    async for part in request.stream():
        content += part
        if len(content) > MOST_BODY_BYTES:
            raise UsageError("the body is too large")
    return json_object(content or b"{}")


def json_object(content: bytes | str) -> Body:
    """The JSON object of a body or a message. Raises UsageError, also for a text that is not Unicode."""
    try:
        value = json.loads(content)
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise UsageError("a text contains half a surrogate pair", "Send Unicode characters.") from None
    except (ValueError, RecursionError):
        raise UsageError("this is not JSON", "Send a JSON object.") from None
    if not isinstance(value, dict):
        raise UsageError("this is not a JSON object", "Send an object, e.g. {}.")
    return value


def text_of(asked: Body, name: str, default: str | None = "") -> str:
    """A text in a body. Raises UsageError if it is not a text, or missing without a default."""
    value = asked.get(name, default)
    if not isinstance(value, str):
        raise UsageError(f"{name} must be a string")
    return value


def key_of(asked: Body) -> str | None:
    """The key of a WebSocket connection in a body; None if there is none. Raises UsageError."""
    key = asked.get("key")
    if not (key is None or isinstance(key, str)):
        raise UsageError("key must be a string")
    return key


def flag_of(asked: Body, name: str) -> bool:
    """Whether something is requested in a body; not without a value. Raises UsageError."""
    value = asked.get(name, False)
    if not isinstance(value, bool):
        raise UsageError(f"{name} must be true or false")
    return value


def entries_of(numbers: object) -> tuple[int, ...]:
    """Numbers of entries of the history. Raises UsageError."""
    given = numbers if isinstance(numbers, list) else []
    right = all(type(number) is int and 0 < number < 10**_MOST_DIGITS for number in given)
    if not right or not 1 <= len(given) <= HISTORY_LIMIT:
        raise UsageError(
            "entries is not a list of numbers of the history", f"Give 1 to {HISTORY_LIMIT} numbers."
        )
    return tuple(given)


def filter_of(request: Request) -> Filter:
    """The filter of a query. Raises UsageError."""
    asked = request.query_params
    known = {"status", "layout", "file", "since", "until", "limit", "entries"}
    if unknown := set(asked) - known:
        raise UsageError(f"unknown filter {min(unknown)[:40]!r}", f"Use {', '.join(sorted(known))}.")
    limit = _whole(asked.get("limit", "50"))
    if limit is None or not 1 <= limit <= HISTORY_LIMIT:
        raise UsageError("the limit is out of range", f"Give 1 to {HISTORY_LIMIT}.")
    numbers: tuple[int, ...] = ()
    if "entries" in asked:
        numbers = entries_of([_whole(text) for text in asked["entries"].split(",", HISTORY_LIMIT + 1)])
        limit = HISTORY_LIMIT
    return Filter(
        status=asked.get("status") or None,
        layout=asked.get("layout") or None,
        file=asked.get("file") or None,
        since=asked.get("since") or None,
        until=asked.get("until") or None,
        limit=limit,
        numbers=numbers,
    )


def _whole(text: str) -> int | None:
    """A number of digits only; None for another text."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= _MOST_DIGITS else None


def number_in(request: Request) -> int:
    """The number in the path of a request."""
    return int(request.path_params["number"])


Handler = Callable[[Station, Request], Awaitable[Response | bytes | wire.Json]]
"""Answers a request; bytes and JSON values are the content of a response."""


@dataclass(frozen=True)
class Operation:
    """A method of a path: who handles its requests, and how /api/v1/openapi.json describes it.

    Attributes:
        path: that of a route.
        asked: schema of the body, or its media type; empty without a body.
        status, answer: of a response that is no refusal, with the schema of its content, or its media type.
        parameters: besides those in the path.
        refused: statuses of refusals.
    """

    handler: Handler
    method: str
    path: str
    summary: str
    asked: str
    status: int
    answer: str
    parameters: tuple[wire.Json, ...]
    refused: tuple[int, ...]

    async def respond(self, station: Station, request: Request) -> Response:
        content = await self.handler(station, request)
        if isinstance(content, bytes):
            return Response(content, self.status, media_type=self.answer)
        return content if isinstance(content, Response) else as_json(content, self.status)


class Operations(list[Operation]):
    """The operations of a module, added by the decorators of their handlers."""

    def get(
        self, path: str, summary: str, answer: str, *parameters: wire.Json, missing: bool = False
    ) -> Callable[[Handler], Handler]:
        """Adds a GET, of what may be missing."""
        refused = (401, 404) if missing else (401,)
        return self._adding("GET", path, summary, "", 200, answer, parameters, refused)

    def post(
        self,
        path: str,
        summary: str,
        asked: str,
        status: int,
        answer: str,
        *parameters: wire.Json,
        refused: tuple[int, ...] = (),
    ) -> Callable[[Handler], Handler]:
        """Adds a POST, with the statuses of refusals that not every POST has."""
        codes = (400, 401, 403, 409, *refused, 503, 507)
        return self._adding("POST", path, summary, asked, status, answer, parameters, codes)

    def _adding(self, *facts: Any) -> Callable[[Handler], Handler]:
        def add(handler: Handler) -> Handler:
            self.append(Operation(handler, *facts))
            return handler

        return add


def as_json(value: wire.Json, status: int = 200) -> Response:
    """A JSON response; numbers that are not finite become null."""
    return Response(wire.to_text(value), status, media_type="application/json")


def attached(content: bytes | str, media_type: str, name: str) -> Response:
    """A file to be stored by the browser; the name is a constant or a validated slug."""
    headers = {"content-disposition": f'attachment; filename="{name}"'}
    return Response(content, media_type=media_type, headers=headers)


def refused(status: int, code: str, message: str, remedy: str) -> Response:
    return JSONResponse({"error": Problem(code, message, remedy).to_json()}, status_code=status)


def refusal_of(error: Exception, place: str) -> Refusal:
    """The status of an exception of a handler and what its client is shown.

    A fault of the program is logged, with the path of the request.
    """
    shown = reported(error)
    if isinstance(shown, UnexpectedError):
        logging.getLogger("tagid").error("%.*s: %s: %s", _LOGGED, place, type(error).__name__, error)
        return Refusal(500, "failed", "the station failed to answer", "See its log for the reason.")
    status = next(code for kind, code in STATUSES if isinstance(shown, kind))
    words = wire.in_page_words
    return Refusal(status, shown.code, words(shown.message), words(shown.remedy))


async def on_error(request: Request, error: Exception) -> Response:
    refusal = refusal_of(error, request.url.path)
    return JSONResponse({"error": refusal.entry}, status_code=refusal.status)


async def on_gone(request: Request, error: Exception) -> Response:
    """The response for a client that is gone, which nobody reads."""
    return Response(status_code=400)


async def on_missing(request: Request, error: Exception) -> Response:
    """The response for a path or method that does not exist."""
    return refused(404, "not_found", "there is no such address", "See /api/v1/openapi.json.")
