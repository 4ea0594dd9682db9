"""Checks of the files that a command will write, made before its work: a recording is never overwritten."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from tagid.errors import StorageError, UsageError
from tagid.files import is_read_only, storage_error


def check_new(
    path: Path, force: bool, how: str = "Choose another name, or add --force.", inputs: Sequence[Path] = ()
) -> None:
    """Check a file that replaces another only where the user says so, and never one that is read.

    Raises UsageError for one of the inputs, StorageError where a file may not be overwritten, with the remedy
    `how`, or nothing can be written.
    """
    if _is_file(path):
        _check_other(path, inputs, str(path))
        if not force:
            raise StorageError(f"{path} exists already", how)
    _check_folder(path)


def check_own(path: Path, own: Callable[[Path], bool], what: str) -> None:
    """Check a file that may replace an earlier one of its kind, which its content tells.

    Args:
        own: whether an existing file is of the kind.
        what: the kind, for messages, e.g. "an export of the history".

    Raises StorageError: a folder, another file, or nothing can be written there.
    """
    if _is_file(path) and not own(path):
        raise StorageError(f"{path} exists already and is not {what}", "Choose another name.")
    _check_folder(path)


def check_drawing(
    option: str, path: Path | None, suffixes: Sequence[str], inputs: Sequence[Path] = ()
) -> None:
    """Check a file that is made from others and may replace an earlier one of its kind.

    Args:
        option: as the user wrote it, for messages.
        path: file to write; None: not requested.
        suffixes: of its kind, in lower case, e.g. ".png".
        inputs: files that the command reads.

    Raises UsageError for another suffix or one of the inputs, StorageError for a folder, an NPZ file that is
    not an image, or where nothing can be written.
    """
    if path is None:
        return
    from tagid.storage.npz import is_image

    if path.suffix.lower() not in suffixes:
        raise UsageError(
            f"{option} {path} does not end in {' or '.join(suffixes)}",
            f"Give a name that does, e.g. {option} NAME{suffixes[0]}.",
        )
    if _is_file(path):
        _check_other(path, inputs, f"{option} {path}")
        if path.suffix.lower() == ".npz" and not is_image(path):
            raise StorageError(f"{path} exists already and is not an image", "Choose another name.")
    _check_folder(path)


def _check_other(path: Path, inputs: Sequence[Path], said: str) -> None:
    """Raises UsageError for an existing file that is one of the inputs, by whatever name."""
    if any(_exists(other) and other.samefile(path) for other in inputs):
        what = "the file that is read" if len(inputs) == 1 else "one of the files that are read"
        raise UsageError(f"{said} is {what}", "Choose another name for the output.")


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError as error:  # a name that is too long, for example
        raise storage_error(error, path, "writing") from None


def _is_file(path: Path) -> bool:
    """Whether a file is there. Raises StorageError for a folder."""
    there = _exists(path)
    if there and path.is_dir():
        raise StorageError(f"{path}: is a folder, not a file", "Give the path of a file.")
    return there


def _check_folder(path: Path) -> None:
    folder = path.parent
    if not _exists(folder):
        raise StorageError(f"{path}: the folder {folder} does not exist", "Create it, or choose another.")
    if not folder.is_dir():
        raise StorageError(f"{path}: {folder} is not a folder", "Check the path.")
    if not os.access(folder, os.W_OK | os.X_OK):
        if is_read_only(folder):
            raise storage_error(OSError(errno.EROFS, "Read-only file system"), path, "writing")
        raise StorageError(
            f"{path}: no permission to write into {folder}", "Check the permissions, or choose another."
        )
