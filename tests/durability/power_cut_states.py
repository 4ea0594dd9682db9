"""States of a folder after a power cut, built from recorded system calls.

What POSIX promises, and no more: a write or truncation is on disk after a later fsync of the file, a name
after a later fsync of its folder. Of everything else any part may be there: each operation may be missing,
whole or, if it is a write, torn at sectors, and later ones may be there without earlier ones. A rename is
atomic. Current file systems order more than this; the model is that of T. S. Pillai et al., "All File Systems
Are Not Created Equal", OSDI 2014.
"""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from syscalls import (
    ROOT,
    UNRECORDED,
    Link,
    Operation,
    Recording,
    Rename,
    Sync,
    Truncate,
    Unlink,
    Write,
    cut_to,
    write_into,
)

_SECTOR = 512
_Effect = Write | Truncate | Link | Rename | Unlink


@dataclass(frozen=True)
class State:
    """What may be in the folder after a power cut."""

    cut: int  # line of the trace; operations that started later never happened
    files: Mapping[str, bytes]  # content by name, relative to the folder
    folders: tuple[str, ...]

    def put(self, place: Path) -> None:
        """Write the state into an empty folder."""
        for name in self.folders:
            (place / name).mkdir()
        for name, content in self.files.items():
            (place / name).write_bytes(content)


@dataclass(frozen=True)
class Density:
    """How many states: `each` chosen at random and four more, after one operation of `every` and the last."""

    each: int = 8
    every: int = 1


def states(
    recording: Recording, stage: Callable[[int], object], density: Density, rng: random.Random
) -> Iterator[State]:
    """Different states, in the order of their cuts.

    The four at each cut are nothing and everything of what is not synced, names without data and data without
    names. The others are chosen at random from: all but one, one alone, one torn, and random subsets. A state
    that was given is given again where `stage` says that more is promised.
    """
    disk = _Disk(recording)
    seen: set[tuple[bytes, object]] = set()
    cuts = [operation.end + 1 for operation in recording.operations]
    for cut in sorted({*cuts[:: density.every], cuts[-1]}):
        disk.advance(cut)
        for choice in _choices(disk.pending, disk.extending, density.each, rng):
            state = disk.state(cut, choice)
            key = (_digest(state), stage(cut))
            if key not in seen:
                seen.add(key)
                yield state


_Choice = Mapping[int, str]
"""Pending operations that are on disk, by position, and how much of each write."""


def _objects(operation: _Effect) -> int:
    """Inode that has to be synced for the operation to last."""
    return operation.inode if isinstance(operation, Write | Truncate) else operation.folder


class _Disk:
    """What is durable at a cut, and what is pending."""

    def __init__(self, recording: Recording) -> None:
        self.pending: list[_Effect] = []
        self.extending = _extending(recording.operations)
        self._waiting = [
            (operation, _durable_at(operation, recording.operations))
            for operation in recording.operations
            if isinstance(operation, _Effect)
        ]
        self._contents: dict[int, bytearray] = {}
        self._names: dict[int, dict[str, int]] = {ROOT: {}}
        self._folders = {ROOT} | {
            operation.inode
            for operation in recording.operations
            if isinstance(operation, Link) and operation.is_folder
        }
        self._random = random.Random(1)

    def advance(self, cut: int) -> None:
        """Make durable what is synced before `cut`; the rest of what started before it is pending."""
        waiting = []
        self.pending = []
        for first, durable_at in self._waiting:
            if durable_at < cut:
                _apply(first, self._contents, self._names, "whole", self._random)
                continue
            waiting.append((first, durable_at))
            if first.start < cut:
                self.pending.append(first)
        self._waiting = waiting

    def state(self, cut: int, choice: _Choice) -> State:
        """The durable state with the chosen pending operations."""
        contents = dict(self._contents)
        names = {folder: dict(entries) for folder, entries in self._names.items()}
        copied: set[int] = set()
        for position, how in sorted(choice.items()):
            single = self.pending[position]
            if isinstance(single, Write | Truncate) and single.inode not in copied:
                contents[single.inode] = bytearray(contents.get(single.inode, b""))
                copied.add(single.inode)
            _apply(single, contents, names, how, self._random)
        files: dict[str, bytes] = {}
        folders: list[str] = []

        def walk(folder: int, prefix: str) -> None:
            for name, inode in names.get(folder, {}).items():
                if inode in self._folders:
                    folders.append(prefix + name)
                    walk(inode, f"{prefix}{name}/")
                else:
                    files[prefix + name] = bytes(contents.get(inode, b""))
                    if name.endswith(UNRECORDED):
                        files[prefix + name] = random.Random(cut).randbytes(len(files[prefix + name]))

        walk(ROOT, "")
        return State(cut, files, tuple(folders))


def _durable_at(operation: _Effect, operations: Sequence[Operation]) -> float:
    """Line at which the first sync that started after the operation ended; infinite if there is none."""
    wanted = _objects(operation)
    ends = [
        item.end
        for item in operations
        if isinstance(item, Sync) and item.inode == wanted and item.start > operation.end
    ]
    return min(ends, default=float("inf"))


def _apply(
    effect: _Effect,
    contents: dict[int, bytearray],
    names: dict[int, dict[str, int]],
    how: str,
    rng: random.Random,
) -> None:
    if isinstance(effect, Write):
        for offset, data in _parts(effect, how, rng):
            write_into(contents.setdefault(effect.inode, bytearray()), offset, data)
    elif isinstance(effect, Truncate):
        cut_to(contents.setdefault(effect.inode, bytearray()), effect.size)
    elif isinstance(effect, Link):
        names.setdefault(effect.folder, {})[effect.name] = effect.inode
    elif isinstance(effect, Rename):
        entries = names.setdefault(effect.folder, {})
        if entries.get(effect.old) == effect.inode:
            del entries[effect.old]
        entries[effect.new] = effect.inode
    else:
        entries = names.setdefault(effect.folder, {})
        if entries.get(effect.name) == effect.inode:
            del entries[effect.name]


def _parts(write: Write, how: str, rng: random.Random) -> Iterator[tuple[int, bytes]]:
    """(offset, data) of what is on disk of a write: it may end anywhere or lack any of its sectors."""
    data, first = write.data, write.offset
    if how == "whole":
        yield first, data
    elif how == "cut off":
        yield first, data[: rng.randrange(len(data) + 1)]
    elif how == "zeros":  # the file grew, its data never came
        yield first, bytes(len(data))
    else:
        at = 0
        while at < len(data):
            size = _SECTOR - (first + at) % _SECTOR
            if rng.random() < 0.5:
                yield first + at, data[at : at + size]
            at += size


def _choices(
    pending: Sequence[_Effect], extending: set[int], most: int, rng: random.Random
) -> Iterator[_Choice]:
    everything = range(len(pending))
    yield {}
    if not pending:
        return
    names = [i for i in everything if not isinstance(pending[i], Write | Truncate)]
    for there in (everything, names, sorted(set(everything) - set(names))):
        yield dict.fromkeys(there, "whole")
    choices: list[_Choice] = []
    for i in everything:
        choices += [dict.fromkeys((j for j in everything if j != i), "whole"), {i: "whole"}]
        # Zeros in place of old data would be a damaged disk: only what extends the file may be missing so.
        for how in ("cut off", "sectors", *(["zeros"] if pending[i].end in extending else [])):
            if isinstance(pending[i], Write):
                choices += [dict.fromkeys(reach, "whole") | {i: how} for reach in (everything, range(i))]
    for _ in range(max(4, most // 4)):
        share = rng.choice((0.2, 0.5, 0.8, 0.95))
        present = [i for i in everything if rng.random() < share]
        choices.append({i: rng.choice(("whole", "whole", "cut off", "sectors")) for i in present})
    yield from rng.sample(choices, min(most, len(choices)))


def _extending(operations: Sequence[Operation]) -> set[int]:
    """Ends of the writes that lie behind all that their file held."""
    sizes: dict[int, int] = {}
    result = set()
    for operation in operations:
        if isinstance(operation, Truncate):
            sizes[operation.inode] = operation.size
        elif isinstance(operation, Write):
            if operation.offset >= sizes.get(operation.inode, 0):
                result.add(operation.end)
            sizes[operation.inode] = max(
                sizes.get(operation.inode, 0), operation.offset + len(operation.data)
            )
    return result


def _digest(state: State) -> bytes:
    total = hashlib.blake2b(repr(state.folders).encode())
    for name, content in sorted(state.files.items()):
        total.update(repr((name, len(content))).encode())
        total.update(hashlib.blake2b(content).digest())
    return total.digest()
