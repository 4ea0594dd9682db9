"""The captures of a batch, collected from files, folders and URLs.

A folder may also contain pictures, reports and notes; only files that claim to be a recording become items.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tagid import files
from tagid.constants import CAPTURE_SUFFIX
from tagid.counting import counted
from tagid.errors import DataError, MissingExtraError, StorageError, displayable
from tagid.storage import mrm_ret, npz
from tagid.storage.journal import being_recorded

SUFFIXES = (CAPTURE_SUFFIX, ".h5", ".hdf5", ".npz", ".prd", ".out", ".csv", ".tagid.journal", ".journal")
"""File suffixes of recordings, in lower case."""
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*(::[A-Za-z0-9+.-]+)*://")
_HEAD = 1 << 16


@dataclass(frozen=True)
class Source:
    """One item's input.

    Attributes:
        location: absolute path (surrogates stand for bytes that are not UTF-8), or URL.
        name: the path or URL as given, as printable text.
    """

    location: str
    name: str

    @classmethod
    def of(cls, word: str) -> Source:
        """The input for a path or URL; a path is made absolute, for workers in other folders."""
        return cls(word if is_url(word) else str(Path(word).absolute()), displayable(word))

    @property
    def is_url(self) -> bool:
        """Whether the input is opened with fsspec."""
        return is_url(self.location)


@dataclass(frozen=True)
class Collected:
    """Result of collecting inputs.

    Attributes:
        sources: the items, each once, those of a folder sorted by name.
        passed_over: names of files that are not recordings.
        being_recorded: names of journals that a recording is writing at the moment.
        unreadable: folders that could not be listed, with the reason.
        dangling: names of recordings that are links to files that do not exist.
    """

    sources: tuple[Source, ...]
    passed_over: tuple[str, ...] = ()
    being_recorded: tuple[str, ...] = ()
    unreadable: tuple[str, ...] = ()
    dangling: tuple[str, ...] = ()


def is_url(text: str) -> bool:
    """Whether a command-line argument is an fsspec URL, e.g. s3://bucket/folder."""
    return _URL.match(text) is not None


def collect(words: Sequence[str], outside: Path | None = None) -> Collected:
    """The items in files, folders (recursively) and URLs, without those in the folder `outside`.

    A file that is named explicitly is an item regardless of its content.

    Raises:
        StorageError: a path does not exist, or a folder cannot be listed.
        DataError: no captures were found.
        MissingExtraError: a URL without fsspec.
    """
    sources: dict[str, Source] = {}
    passed_over: list[str] = []
    recording: list[str] = []
    unreadable: list[str] = []
    dangling: list[str] = []
    for word in words:
        if is_url(word):
            for location in _of_url(word):
                sources.setdefault(location, Source.of(location))
            continue
        path = Path(word)
        try:
            folder = path.is_dir()
            if not folder:
                path.stat()
        except OSError as error:
            raise files.storage_error(error, path, "looking for captures") from error
        if not folder:
            sources.setdefault(str(path), Source.of(str(path)))
            continue
        for file in files_below(path, unreadable, outside, dangling):
            if is_recording(file):
                sources.setdefault(str(file), Source.of(str(file)))
            elif _journal_under_way(file):
                recording.append(displayable(str(file)))
            else:
                passed_over.append(displayable(str(file)))
    lists = map(tuple, (passed_over, recording, unreadable, dangling))
    collected = Collected(tuple(sources.values()), *lists)
    if not sources:
        raise _nothing(words, collected)
    return collected


def files_below(
    folder: Path,
    unreadable: list[str],
    outside: Path | None = None,
    dangling: list[str] | None = None,
) -> Iterable[Path]:
    """All regular files of a folder and its subfolders, sorted by name.

    Hidden files and links to folders are omitted. Subfolders that cannot be listed are added to `unreadable`,
    links without a target that are named like recordings to `dangling`; the folder itself raises
    StorageError.
    """
    avoid = None if outside is None else outside.resolve()

    def failed(error: OSError) -> None:
        place = os.fsdecode(error.filename or folder)
        if Path(place) == folder:
            raise files.storage_error(error, folder, "listing it") from error
        unreadable.append(f"{displayable(place)}: {error.strerror}")

    for place, folders, names in os.walk(folder, onerror=failed):
        here = Path(place)
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".") and (avoid is None or (here / name).resolve() != avoid)
        )
        if avoid is not None and here.resolve() == avoid:
            continue
        for name in sorted(names):
            if name.startswith("."):
                continue
            if (here / name).is_file():
                yield here / name
            elif dangling is not None and name.lower().endswith(SUFFIXES) and not (here / name).exists():
                dangling.append(displayable(str(here / name)))


def is_recording(path: Path) -> bool:
    """Whether a file found in a folder is an item, judged by its name and content.

    A damaged recording is an item: it must be listed, not skipped.
    """
    name = path.name.lower()
    if not name.endswith(SUFFIXES):
        return False
    try:
        if name.endswith(".journal"):
            # `tagid scan` writes the recording next to its journal once it is complete.
            stem = path.name[: -len(".journal")].removesuffix(".tagid")
            # Looked for after the lock, because the capture is there before the lock is released.
            return not _journal_under_way(path) and not path.with_name(f"{stem}{CAPTURE_SUFFIX}").exists()
        head = files.read_head(path, _HEAD)
        if name.endswith(".csv"):
            return mrm_ret.is_mrm_ret(head)
        if name.endswith(".npz") and head.startswith(npz.MAGIC):
            return not npz.is_image(path)
    except (OSError, StorageError):
        return True
    return True


def _journal_under_way(path: Path) -> bool:
    return path.name.lower().endswith(".journal") and being_recorded(path)


def _nothing(words: Sequence[str], seen: Collected) -> DataError:
    where = ", ".join(displayable(word) for word in words[:3])
    others = f"; not recordings: {counted(len(seen.passed_over), 'other file')}" if seen.passed_over else ""
    under_way = f"; {seen.being_recorded[0]} is still being recorded" if seen.being_recorded else ""
    closed = f"; could not open {seen.unreadable[0]}" if seen.unreadable else ""
    links = f"; {seen.dangling[0]}: a link to a file that does not exist" if seen.dangling else ""
    return DataError(
        f"no captures in {where}{others}{under_way}{closed}{links}",
        f"Captures end in {', '.join(SUFFIXES)}; a file with any other name must be named explicitly.",
    )


def filesystem(url: str) -> tuple[Any, str]:
    """The fsspec file system of a URL and the path on it.

    Raises MissingExtraError if fsspec, or a package it needs for this kind of URL, is not installed;
    StorageError if the URL is invalid.
    """
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise MissingExtraError(
            f"{url} needs fsspec, which is not installed", "Install it with `pip install 'tagid[cluster]'`."
        ) from None
    try:
        return url_to_fs(url)  # type: ignore[no-any-return]
    except ImportError as error:
        raise MissingExtraError(f"{url}: {error}", "Install the package that it names.") from None
    except (ValueError, OSError, TypeError) as error:
        raise StorageError(f"{url}: {error}", "Check the URL.") from error


def _of_url(url: str) -> list[str]:
    """URLs of the captures at a URL: the URL itself, the files of a folder, or the matches of a pattern."""
    files, path = filesystem(url)
    prefix = url[: len(url) - len(path)] if url.endswith(path) else url.split("://", 1)[0] + "://"
    try:
        if any(sign in path for sign in "*?["):
            names = sorted(str(name) for name in files.glob(path))
        elif files.isdir(path):
            names = sorted(str(name) for name in files.find(path))
            names = [name for name in names if name.lower().endswith(SUFFIXES)]
        elif files.exists(path):
            return [url]
        else:
            raise StorageError(f"{url}: no such file or folder", "Check the URL.")
    except (OSError, ValueError, NotImplementedError) as error:
        raise StorageError(
            f"{url}: cannot be listed: {error}", "Check the URL, the network and your permissions."
        ) from error
    return [name if is_url(name) else prefix + name for name in names]
