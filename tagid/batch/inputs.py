"""Which captures a batch works on: files, folders and URLs, told apart from what merely lies beside them.

A folder holds pictures, reports and notes too; what claims to be a recording is an item, and all of that.
"""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tagid import files
from tagid.constants import CAPTURE_SUFFIX
from tagid.errors import DataError, MissingExtraError, StorageError, displayable
from tagid.storage import mrm_ret, npz

SUFFIXES = (CAPTURE_SUFFIX, ".h5", ".hdf5", ".npz", ".prd", ".out", ".csv", ".tagid.journal", ".journal")
"""How names of recordings end, in small letters."""
_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*(::[A-Za-z0-9+.-]+)*://")
_HEAD = 1 << 16


@dataclass(frozen=True)
class Source:
    """One item's input.

    Attributes:
        location: absolute path as the operating system has it (surrogates stand for bytes that are not
            UTF-8), or URL.
        name: the path or URL as it was given, as text that can be shown and written.
    """

    location: str
    name: str

    @classmethod
    def of(cls, word: str) -> Source:
        """The input that a path or URL names; a path is made absolute, for workers in other folders."""
        return cls(word if is_url(word) else str(Path(word).absolute()), displayable(word))

    @property
    def is_url(self) -> bool:
        """Whether fsspec has to open it."""
        return is_url(self.location)


@dataclass(frozen=True)
class Collected:
    """What was found.

    Attributes:
        sources: the items, each once, those of a folder in the order of their names.
        passed_over: names of files that are no recordings.
        unreadable: folders that could not be listed, with the reason.
    """

    sources: tuple[Source, ...]
    passed_over: tuple[str, ...] = ()
    unreadable: tuple[str, ...] = ()


def is_url(text: str) -> bool:
    """Whether a command line's word is a URL of fsspec, e.g. s3://bucket/folder."""
    return _URL.match(text) is not None


def collect(words: Sequence[str], outside: Path | None = None) -> Collected:
    """The items behind files, folders (with all below them) and URLs.

    A file that is named is an item whatever it holds.

    Args:
        words: paths or URLs.
        outside: a folder whose contents are never taken, e.g. the report's own.

    Raises:
        StorageError: a path does not exist, or a folder cannot be listed.
        DataError: nothing was found.
        MissingExtraError: a URL without fsspec.
    """
    found: dict[str, Source] = {}
    passed_over: list[str] = []
    unreadable: list[str] = []
    for word in words:
        if is_url(word):
            for location in _of_url(word):
                found.setdefault(location, Source.of(location))
            continue
        path = Path(word)
        try:
            folder = path.is_dir()
            if not folder:
                path.stat()
        except OSError as error:
            raise files.storage_error(error, path, "looking for captures") from error
        if not folder:
            found.setdefault(str(path), Source.of(str(path)))
            continue
        for file in files_below(path, unreadable, outside):
            if is_recording(file):
                found.setdefault(str(file), Source.of(str(file)))
            else:
                passed_over.append(displayable(str(file)))
    if not found:
        raise _nothing(words, passed_over, unreadable)
    return Collected(tuple(found.values()), tuple(passed_over), tuple(unreadable))


def files_below(folder: Path, unreadable: list[str], outside: Path | None = None) -> Iterable[Path]:
    """All regular files of a folder and the folders in it, by name; hidden ones and links to folders are
    left out.

    Folders within that cannot be listed are noted in `unreadable`; the folder itself raises StorageError.
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
            if not name.startswith(".") and (here / name).is_file():
                yield here / name


def is_recording(path: Path) -> bool:
    """Whether a file found in a folder is an item: its name says so, and its content does not say otherwise.

    A damaged recording is one: it must be listed, not passed over.
    """
    name = path.name.lower()
    if not name.endswith(SUFFIXES):
        return False
    try:
        if name.endswith(".journal"):
            # What `tagid scan` recorded from it lies beside it once the recording is complete.
            stem = path.name[: -len(".journal")].removesuffix(".tagid")
            return not path.with_name(f"{stem}{CAPTURE_SUFFIX}").exists()
        head = files.read_head(path, _HEAD)
        if name.endswith(".csv"):
            return mrm_ret.is_mrm_ret(head)
        if name.endswith(".npz") and head.startswith(npz.MAGIC):
            return not _is_image(path)
    except (OSError, StorageError):
        return True
    return True


def _is_image(path: Path) -> bool:
    """Whether an NPZ file holds an image of `tagid reconstruct --out` and no scans."""
    try:
        with zipfile.ZipFile(path) as file:
            names = set(file.namelist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return False
    return "image.npy" in names and "samples.npy" not in names


def _nothing(words: Sequence[str], passed_over: Sequence[str], unreadable: Sequence[str]) -> DataError:
    where = ", ".join(displayable(word) for word in words[:3])
    seen = f"; {len(passed_over)} other file(s) are no recordings" if passed_over else ""
    closed = f"; could not look into {unreadable[0]}" if unreadable else ""
    return DataError(
        f"no captures in {where}{seen}{closed}",
        f"Captures end in {', '.join(SUFFIXES)}; name a file to have it read whatever it is called.",
    )


def filesystem(url: str) -> tuple[Any, str]:
    """The fsspec file system of a URL and the path on it.

    Raises:
        MissingExtraError: fsspec, or what it needs for this kind of URL, is not installed.
        StorageError: the URL cannot be understood.
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
    """URLs of the captures behind a URL: itself, those of a folder, or those that fit a pattern."""
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
            f"{url}: cannot be listed: {error}", "Check the URL, the network and your rights."
        ) from error
    return [name if is_url(name) else prefix + name for name in names]
