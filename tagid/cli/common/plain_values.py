"""Conversion of plain command-line values without pydantic, whose import costs more than most commands.

typer 0.29 validates every value, given or default, with a pydantic adapter. Values of simple types are
converted here instead. All other types, and every value that may be invalid, are left to typer, so error
messages are its own.
"""

from __future__ import annotations

import os
import re
from enum import Enum
from pathlib import Path
from typing import Any, get_args, get_origin

import typer.core

_INTEGER = re.compile(r"[+-]?[0-9]{1,18}")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]{1,3})?")


class _NotPlainError(Exception):
    """The value is converted by typer."""


class PlainCommand(typer.core.TyperCommand):
    """A command whose plain values are converted here."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The parameters, with the help option."""
        return _converted_plainly(super().get_params(ctx))


class PlainGroup(typer.core.TyperGroup):
    """The same for a group of commands."""

    def get_params(self, ctx: Any) -> list[Any]:
        """The parameters, with the help option."""
        return _converted_plainly(super().get_params(ctx))


def _converted_plainly(parameters: list[Any]) -> list[Any]:
    """The parameters, set to the conversion of this module.

    A version of typer without this attribute converts all values itself, as before.
    """
    for parameter in parameters:
        if getattr(parameter, "_runtime_param", "missing") is None:
            parameter._runtime_param = _Plain()
    return parameters


class _Plain:
    """Takes the place of typer's conversion of one parameter."""

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """The converted value. Raises typer's errors for invalid ones."""
        if value is None:
            return () if param.multiple or param.nargs == -1 else None
        try:
            return _converted(value, param.type_descriptor.annotation, param.type_descriptor.parameter_info)
        except _NotPlainError:
            param._runtime_param = None
            try:
                return param.get_runtime_param().coerce(value, param=param, ctx=ctx)
            finally:
                param._runtime_param = self


def _converted(value: Any, kind: Any, info: Any) -> Any:
    """A value of a type. Raises _NotPlainError where typer has to decide."""
    if info.parser is not None or info.clamp:
        raise _NotPlainError
    if get_origin(kind) is list:
        if not isinstance(value, (list, tuple)):
            raise _NotPlainError
        return [_converted(item, get_args(kind)[0], info) for item in value]
    if kind is str and type(value) is str:
        return value
    if kind is int or kind is float:
        return _number(value, kind, info)
    if kind is Path and isinstance(value, (str, Path)):
        return _path(value, info)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return _choice(value, kind)
    raise _NotPlainError


def _number(value: Any, kind: type[int] | type[float], info: Any) -> int | float:
    if type(value) is str:
        if not (_INTEGER if kind is int else _NUMBER).fullmatch(value):
            raise _NotPlainError
    elif type(value) is not kind and type(value) is not int:
        raise _NotPlainError
    number = kind(value)
    below = info.min is not None and number < info.min
    if below or (info.max is not None and number > info.max):
        raise _NotPlainError
    return number


def _path(value: str | Path, info: Any) -> Path:
    checked = info.exists or info.resolve_path or info.writable or info.allow_dash
    if checked or info.path_type is not None or not (info.file_okay and info.dir_okay):
        raise _NotPlainError
    if info.readable and Path(value).exists() and not os.access(value, os.R_OK):
        raise _NotPlainError
    return Path(value)


def _choice(value: Any, kind: type[Enum]) -> Enum:
    if isinstance(value, kind):
        return value
    for member in kind:
        if type(value) is str and value == member.value:
            return member
    raise _NotPlainError
