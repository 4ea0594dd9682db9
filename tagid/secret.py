"""Texts that are never printed, and the URL that may hold one.

Output is made with `str`, `repr`, `format` or `result.render`; for a secret all of them give `***`.
"""

from __future__ import annotations

import re
from typing import Final, NoReturn

HIDDEN: Final = "***"
_PARTS: Final = re.compile("([?&;#])")
_KEYS: Final = re.compile(
    r"(pass[-_]?\w*|key|pin)(=|%3d)[^?&;#,@/ ]+|(?<![\w.%=-])[0-9]{6}(?![\w.%-])", re.IGNORECASE
)


def masked(text: str) -> str:
    """A text about a device, with `***` for whatever looks like a pass-key: after `passkey=`, or six digits.

    >>> masked("looking for R2,passkey=123456"), masked("R2:123456")
    ('looking for R2,passkey=***', 'R2:***')
    """
    return _KEYS.sub(lambda match: f"{match[1]}{match[2]}{HIDDEN}" if match[1] else HIDDEN, text)


class Secret:
    """A text that only `reveal` returns; it cannot be pickled."""

    __slots__ = ("_text",)

    def __init__(self, text: object) -> None:
        self._text = text.reveal() if isinstance(text, Secret) else str(text)

    def reveal(self) -> str:
        """The text, for the device that needs it."""
        return self._text

    def __str__(self) -> str:
        return HIDDEN

    def __repr__(self) -> str:
        return str(self)

    def __format__(self, specification: str) -> str:
        return format(str(self), specification)

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and isinstance(other, Secret) and self._text == other._text

    def __hash__(self) -> int:
        return hash(self._text)

    def __reduce__(self) -> NoReturn:
        raise TypeError("a secret is not stored")


class MotionUrl(Secret):
    """A motion URL; printed with `***` for its pass-key.

    >>> url = MotionUrl("roomba+ble://R2?passkey=123456&step=3")
    >>> str(url), url.public
    ('roomba+ble://R2?passkey=***&step=3', 'roomba+ble://R2?step=3')
    """

    __slots__ = ()

    def __str__(self) -> str:
        head, *rest = _PARTS.split(self._text)
        marks, options = rest[::2], map(_masked_option, rest[1::2])
        return _masked(head) + "".join(map("".join, zip(marks, options, strict=True)))

    @property
    def public(self) -> str:
        """The URL without its pass-key: what is stored, and can be opened again."""
        head, *rest = _PARTS.split(self._text)
        kept = [option for option in rest[1::2] if option and _masked_option(option) == option]
        head = _masked(head)
        return f"{head}?{'&'.join(kept)}" if kept else head

    @property
    def holds_key(self) -> bool:
        """Whether it has a pass-key, well formed or not."""
        return str(self) != self._text


def _masked_option(option: str) -> str:
    """As `_masked`; a number without a name is hidden, too: it may be half of a pass-key."""
    return _masked(option) if "=" in option or not re.search("[0-9]", option) else HIDDEN


def _masked(part: str) -> str:
    """A part of a URL; with `***` for the value of NAME=VALUE if the name, decoded, may mean a pass-key."""
    from urllib.parse import unquote

    name, _, value = part.partition("=")
    letters = re.sub("[^a-z]", "", unquote(unquote(name)).casefold())
    return masked(f"{name}={HIDDEN}" if value and re.search("pass|key|pin$", letters) else part)
