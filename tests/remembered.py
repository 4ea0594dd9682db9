"""What costs seconds and depends on nothing but its arguments is computed once in a session of tests.

The same scans are read, and the same layouts compared, by tests of every door; most are about what follows. A
key is all that the function is given, so a caller that gives it something else gets a result of its own.
A process that a test starts with an interpreter shares them where its environment says so, see `shared`.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import sys
import threading
from collections import defaultdict
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

FUNCTIONS = (
    ("tagid.reading.reader", "read_together"),
    ("tagid.reading.alike", "told_apart"),
    ("tagid.tags.bodies.joint", "enroll_signature"),
)


def remember(folder: Path) -> None:
    """From here on, this process and others with the same folder share the results of `FUNCTIONS`."""
    for module, name in FUNCTIONS:
        _remember(getattr(import_module(module), name), name, folder)


def remember_in(module: Any, folder: str) -> None:
    """The same for the functions of a module that nothing has imported from yet."""
    for home, name in FUNCTIONS:
        if module.__name__ == home:
            setattr(module, name, _remembering(getattr(module, name), name, Path(folder)))


def shared(folder: Path) -> dict[str, str]:
    """What the environment of a child process needs for it."""
    modules = " ".join(module for module, _ in FUNCTIONS)
    children = str(Path(__file__).parent / "children")
    return {"REMEMBERED": str(folder), "REMEMBERED_OF": modules, "PYTHONPATH": children}


def _remember(function: Any, name: str, folder: Path) -> None:
    remembered = _remembering(function, name, folder)
    for place, module in list(sys.modules.items()):
        if place.startswith("tagid.") and getattr(module, name, None) is function:
            setattr(module, name, remembered)


def _remembering(function: Any, name: str, folder: Path) -> Any:
    busy: defaultdict[Path, threading.Lock] = defaultdict(threading.Lock)

    def remembered(*given: Any) -> Any:
        file = folder / f"{name}-{_key(given)}"
        with busy[file]:  # of two threads with the same scans, one reads them
            with suppress(OSError), file.open("rb") as stored:  # a test may have the rights of another user
                return _Unpickler(stored).load()
            made = function(*given)
            part = file.with_suffix(f".{os.getpid()}")
            # The transfer of an enrolled body has functions of its own, which cannot be stored.
            with suppress(OSError, AttributeError, TypeError, pickle.PicklingError):
                with part.open("wb") as stored:
                    _Pickler(stored).dump(made)
                part.replace(file)
            return made

    return remembered


class _Pickler(pickle.Pickler):
    """Stores the transfers that the reader tries, which hold functions, as their names."""

    def persistent_id(self, thing: Any) -> str | None:
        return thing.name if any(thing is known for known in _transfers()) else None


class _Unpickler(pickle.Unpickler):
    def persistent_load(self, name: str) -> Any:
        return next(known for known in _transfers() if known.name == name)


def _transfers() -> tuple[Any, ...]:
    from tagid.reading.hypotheses import TRANSFERS

    return TRANSFERS


def _key(given: tuple[Any, ...]) -> str:
    written = io.BytesIO()
    pickler = pickle.Pickler(written)
    pickler.fast = True  # by value: without references to what was written before
    pickler.dump(given)
    return hashlib.sha256(written.getvalue()).hexdigest()
