"""Operations on files of a traced process, recorded with strace.

strace sees what Python, HDF5 and sqlite alike ask of the operating system. One process with any number of
threads is followed. `record` checks that the result is complete: `Recording.final` equals the folder.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = 0
"""Inode of the recorded folder."""
UNRECORDED = "-shm"
"""End of the names of files written through mapped memory: sqlite's shared index, which it rebuilds."""

_CALLS = (
    "open,openat,creat,close,write,pwrite64,writev,pwritev,pwritev2,ftruncate,truncate,fallocate,lseek,fsync,"
    "fdatasync,sync_file_range,rename,renameat,renameat2,unlink,unlinkat,rmdir,link,linkat,symlink,mkdir,mkdirat,"
    "dup,dup2,dup3,fcntl,copy_file_range,sendfile,chdir,fchdir,clone,clone3,fork,vfork"
)
_STARTING = ("clone", "clone3", "fork", "vfork")
_LONGEST = 16 << 20
_LINE = re.compile(r"(\d+)\s+(\d+\.\d+) (.*)")
_CALL = re.compile(r"(\w+)\((.*)\)\s+= (-?\d+|\?)", re.DOTALL)
_STARTED = re.compile(r"\b(?:clone3?|fork|vfork)(?:\(| resumed>)(.*)= (\d+)$")
_TEXT = re.compile(r'"((?:\\x[0-9a-f]{2})*)"(\.\.\.)?')


@dataclass(frozen=True)
class Operation:
    """One system call. `start` and `end` count lines of the trace; `time_s` is the time of its start, s."""

    start: int
    end: int
    time_s: float


@dataclass(frozen=True)
class Write(Operation):
    """`data` written at `offset` of a file."""

    inode: int
    offset: int
    data: bytes


@dataclass(frozen=True)
class Truncate(Operation):
    """A file cut or extended with zeros to `size` bytes."""

    inode: int
    size: int


@dataclass(frozen=True)
class Sync(Operation):
    """fsync or fdatasync of a file or folder."""

    inode: int


@dataclass(frozen=True)
class Link(Operation):
    """A name for a new file or folder."""

    folder: int
    name: str
    inode: int
    is_folder: bool


@dataclass(frozen=True)
class Rename(Operation):
    """A name moved within a folder, over what had the new name."""

    folder: int
    old: str
    new: str
    inode: int


@dataclass(frozen=True)
class Unlink(Operation):
    """A name removed."""

    folder: int
    name: str
    inode: int


@dataclass(frozen=True)
class Close(Operation):
    """The last thing a thread does with a file."""

    inode: int


@dataclass(frozen=True)
class Mark(Operation):
    """A line that the process wrote to its output: what it has reported so far."""

    text: str


@dataclass(frozen=True)
class Recording:
    """Operations in the order of their ends."""

    operations: tuple[Operation, ...]
    paths: Mapping[int, str]  # last name of each inode, relative to the folder
    contents: Mapping[int, bytes]  # last content of each file, removed ones included, by inode
    final: Mapping[str, bytes]  # content of every file after the last operation, by name

    def marked(self, cut: int) -> list[str]:
        """Lines that the process had written to its output before `cut`."""
        return [mark.text for mark in self.operations if isinstance(mark, Mark) and mark.end < cut]


def unavailable() -> str:
    """Why nothing can be recorded here; empty where strace works."""
    if shutil.which("strace") is None:
        return "strace is not installed"
    probe = subprocess.run(["strace", "-o", os.devnull, "true"], capture_output=True, text=True)
    return "" if probe.returncode == 0 else f"strace may not trace here: {probe.stderr.strip()[:100]}"


def record(command: Sequence[str], folder: Path, environment: Mapping[str, str], log: Path) -> Recording:
    """Run a command in `folder` to its end and return what it did to the files below.

    Raises AssertionError: the command failed, or the recorded operations do not give the files on disk.
    """
    folder = folder.resolve()
    if list(folder.iterdir()):
        raise ValueError(f"{folder} is not empty")
    words = ["strace", "-f", "-ttt", "-xx", "-s", str(_LONGEST), "--seccomp-bpf", "-e", f"trace={_CALLS}"]
    done = subprocess.run(
        [*words, "-o", str(log), *command], cwd=folder, env=dict(environment),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    recorder = _Recorder(folder)
    for call in _calls(_of_one_process(log.read_text().splitlines())):
        recorder.take(call)
    recording = recorder.finished()
    actual = {
        str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }
    assert actual.keys() == recording.final.keys(), (actual.keys(), recording.final.keys())
    for name, content in actual.items():
        assert name.endswith(UNRECORDED) or content == recording.final[name], name
    return recording


@dataclass(frozen=True)
class _Call:
    start: int
    end: int
    time_s: float
    name: str
    arguments: str
    result: int


def _of_one_process(lines: Sequence[str]) -> Iterator[tuple[int, str]]:
    """Numbered lines of the first process and its threads, without those of processes that it started."""
    begun: dict[str, str] = {}
    others = set()
    for line in lines:
        thread = line.split(" ", 1)[0]
        if line.endswith("<unfinished ...>"):
            begun[thread] = line
        match = _STARTED.search(line)
        if match is not None:
            arguments = begun.get(thread, "") + match[1] if "resumed>" in line else match[1]
            if "CLONE_THREAD" not in arguments:
                others.add(match[2])
    for number, line in enumerate(lines):
        if line.split(" ", 1)[0] not in others:
            yield number, line


def _calls(lines: Iterator[tuple[int, str]]) -> Iterator[_Call]:
    """Calls that ended and did not fail, with those that another thread interrupted put together."""
    begun: dict[str, tuple[int, float, str]] = {}
    for number, line in lines:
        matched = _LINE.match(line)
        if matched is None:
            continue
        thread, time_s, rest = matched[1], float(matched[2]), matched[3]
        start = number
        if rest.endswith("<unfinished ...>"):
            begun[thread] = (number, time_s, rest.removesuffix("<unfinished ...>").rstrip())
            continue
        resumed = re.match(r"<\.\.\. \w+ resumed>(.*)", rest)
        if resumed is not None:
            start, time_s, head = begun.pop(thread)
            rest = head + resumed[1]
        call = _CALL.match(rest)
        if call is not None and call[3] != "?" and int(call[3]) >= 0:
            yield _Call(start, number, time_s, call[1], call[2], int(call[3]))


@dataclass
class _Open:
    inode: int
    append: bool
    position: int = 0


@dataclass
class _Recorder:
    folder: Path
    operations: list[Operation] = field(default_factory=list)
    names: dict[int, dict[str, int]] = field(default_factory=lambda: {ROOT: {}})
    contents: dict[int, bytearray] = field(default_factory=dict)
    paths: dict[int, str] = field(default_factory=lambda: {ROOT: ""})
    open: dict[int, _Open] = field(default_factory=dict)

    def take(self, call: _Call) -> None:
        """Apply one call."""
        do = getattr(self, f"_{call.name}", None)
        if call.name in _STARTING:
            return
        if do is not None:
            do(call)
            return
        descriptor = re.match(r"(\d+)", call.arguments)
        if descriptor is not None and int(descriptor[1]) not in self.open:
            return
        named = [text for text in _texts(call.arguments) if self._place(text) is not None]
        if descriptor is not None or named:
            raise ValueError(f"{call.name} is not recorded: {call.arguments[:200]}")

    def finished(self) -> Recording:
        """Everything taken so far."""
        final: dict[str, bytes] = {}

        def walk(folder: int, prefix: str) -> None:
            for name, inode in self.names[folder].items():
                if inode in self.names:
                    walk(inode, f"{prefix}{name}/")
                else:
                    final[prefix + name] = bytes(self.contents[inode])

        walk(ROOT, "")
        operations = sorted(self.operations, key=lambda item: item.end)
        contents = {inode: bytes(content) for inode, content in self.contents.items()}
        return Recording(tuple(operations), self.paths, contents, final)

    def _place(self, raw: bytes) -> tuple[int, str] | None:
        """(inode of the folder, name) of a path; None outside the recorded folder."""
        path = Path(os.path.normpath(self.folder / os.fsdecode(raw)))
        if not path.is_relative_to(self.folder):
            return None
        parts = path.relative_to(self.folder).parts
        if not parts:
            return ROOT, ""
        folder = ROOT
        for part in parts[:-1]:
            folder = self.names[folder][part]
        return folder, parts[-1]

    def _new(self, call: _Call, place: tuple[int, str], is_folder: bool) -> int:
        folder, name = place
        inode = len(self.paths)
        self.paths[inode] = f"{self.paths[folder]}/{name}".lstrip("/")
        self.names[folder][name] = inode
        if is_folder:
            self.names[inode] = {}
        else:
            self.contents[inode] = bytearray()
        self.operations.append(Link(call.start, call.end, call.time_s, folder, name, inode, is_folder))
        return inode

    def _openat(self, call: _Call) -> None:
        self.open.pop(call.result, None)
        place = self._place(_texts(call.arguments)[0])
        if place is None:
            return
        flags = call.arguments.rpartition('"')[2]
        folder, name = place
        inode = ROOT if not name else self.names[folder].get(name)
        if inode is None:
            inode = self._new(call, place, False)
        elif "O_TRUNC" in flags:
            self._cut(call, inode, 0)
        self.open[call.result] = _Open(inode, "O_APPEND" in flags)

    _open = _openat

    def _close(self, call: _Call) -> None:
        known = self.open.pop(int(call.arguments), None)
        if known is not None:
            self.operations.append(Close(call.start, call.end, call.time_s, known.inode))

    def _dup(self, call: _Call) -> None:
        source = int(call.arguments.split(",")[0])
        self.open.pop(call.result, None)
        if source in self.open:
            self.open[call.result] = self.open[source]

    _dup2 = _dup3 = _dup

    def _fcntl(self, call: _Call) -> None:
        if "F_DUPFD" in call.arguments:
            self._dup(call)

    def _lseek(self, call: _Call) -> None:
        known = self.open.get(int(call.arguments.split(",")[0]))
        if known is not None:
            known.position = call.result

    def _write(self, call: _Call) -> None:
        descriptor = int(call.arguments.split(",")[0])
        if descriptor in self.open:
            known = self.open[descriptor]
            at = len(self.contents[known.inode]) if known.append else known.position
            known.position = self._put(call, known.inode, at)
        elif descriptor == 1:
            text = _texts(call.arguments)[0].decode(errors="replace")
            self.operations.append(Mark(call.start, call.end, call.time_s, text.strip()))

    def _pwrite64(self, call: _Call) -> None:
        known = self.open.get(int(call.arguments.split(",")[0]))
        if known is not None:
            self._put(call, known.inode, int(call.arguments.rpartition(",")[2]))

    def _put(self, call: _Call, inode: int, offset: int) -> int:
        data = _texts(call.arguments)[0][: call.result]
        operation = Write(call.start, call.end, call.time_s, inode, offset, data)
        write_into(self.contents[inode], offset, data)
        self.operations.append(operation)
        return offset + len(data)

    def _ftruncate(self, call: _Call) -> None:
        descriptor, size = call.arguments.split(",")
        if int(descriptor) in self.open:
            self._cut(call, self.open[int(descriptor)].inode, int(size))

    def _cut(self, call: _Call, inode: int, size: int) -> None:
        cut_to(self.contents[inode], size)
        self.operations.append(Truncate(call.start, call.end, call.time_s, inode, size))

    def _fsync(self, call: _Call) -> None:
        known = self.open.get(int(call.arguments))
        if known is not None:
            self.operations.append(Sync(call.start, call.end, call.time_s, known.inode))

    _fdatasync = _fsync

    def _mkdir(self, call: _Call) -> None:
        place = self._place(_texts(call.arguments)[0])
        if place is not None:
            self._new(call, place, True)

    def _rename(self, call: _Call) -> None:
        positions = [self._place(text) for text in _texts(call.arguments)]
        if positions == [None, None]:
            return
        if None in positions or positions[0][0] != positions[1][0]:  # type: ignore[index]
            raise ValueError("a name was moved to another folder")
        (folder, old), (_, new) = positions  # type: ignore[misc]
        inode = self.names[folder].pop(old)
        self.names[folder][new] = inode
        self.paths[inode] = f"{self.paths[folder]}/{new}".lstrip("/")
        self.operations.append(Rename(call.start, call.end, call.time_s, folder, old, new, inode))

    def _unlink(self, call: _Call) -> None:
        place = self._place(_texts(call.arguments)[0])
        if place is not None:
            folder, name = place
            inode = self.names[folder].pop(name)
            self.operations.append(Unlink(call.start, call.end, call.time_s, folder, name, inode))

    def _chdir(self, call: _Call) -> None:
        raise ValueError("the process changes its folder")

    _fchdir = _chdir


def write_into(content: bytearray, offset: int, data: bytes) -> None:
    """Write into a file's content; a hole before `offset` reads as zeros."""
    if offset > len(content):
        content.extend(bytes(offset - len(content)))
    content[offset : offset + len(data)] = data


def cut_to(content: bytearray, size: int) -> None:
    """Cut or extend a file's content with zeros."""
    del content[size:]
    content.extend(bytes(size - len(content)))


def _texts(arguments: str) -> list[bytes]:
    results = []
    for text, more in _TEXT.findall(arguments):
        if more:
            raise ValueError("a write is longer than what strace was told to keep")
        results.append(bytes.fromhex(text.replace("\\x", "")))
    return results
