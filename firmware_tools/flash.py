"""Checks a MicroPython image, writes it with esptool and reads it back; tells an incomplete flash.

Images come from micropython.org; the hash detects an incomplete download and tampering.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import re
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from firmware_tools.board import CHIPS, Chip
from firmware_tools.build import EXTRA
from tagid.errors import (
    DeviceError,
    DeviceGoneError,
    DeviceRejectedError,
    FileFormatError,
    MissingExtraError,
    UsageError,
)
from tagid.files import read_bytes
from tagid.ports import open_port

_BAUD: Final = 115200
_LARGEST: Final = 16 << 20
_SMALLEST: Final = 512 << 10
_MAGIC: Final = 0xE9
_APP_DESCRIPTION: Final = struct.pack("<I", 0xABCD5432)
"""Magic word of an application's description, behind the 24 + 8 byte headers (ESP-IDF `esp_app_desc_t`)."""
_NAMES: Final = {0: "ESP32", 2: "ESP32-S2", 5: "ESP32-C3", 9: "ESP32-S3", 12: "ESP32-C2", 13: "ESP32-C6"}
_VERSION: Final = re.compile(rb"MicroPython v?(\d+\.\d+(?:\.\d+)?)|v(1\.\d{2}\.\d+)(?:-\w+)*\x00")
FlashProgress = Callable[[float, str], None]


@dataclass(frozen=True)
class Image:
    """A checked image: its bytes, hash (hex), chip, and MicroPython version if it contains one."""

    data: bytes
    sha256: str
    chip: Chip
    version: str


def wanted_hash(path: Path, given: str | None) -> str:
    """The hash to expect: the one given, or that of the file IMAGE.sha256 next to the image.

    Raises:
        UsageError: no hash is known, or it is not a SHA-256.
        StorageError: the image is missing.
    """
    beside = path.with_name(path.name + ".sha256")
    text = given
    if text is None and beside.is_file():
        text = (read_bytes(beside, 4096).decode("utf-8", "replace").split() or [""])[0]
    if text is None:
        actual = hashlib.sha256(read_bytes(path, _LARGEST)).hexdigest()
        raise UsageError(
            f"{path}: no hash to check it against (it has sha256 {actual})",
            "Compare it with the published hash and pass it with --sha256, or store it in a file "
            f"{beside.name} next to the image.",
        )
    if not re.fullmatch(r"[0-9a-fA-F]{64}", text):
        raise UsageError(f"{text[:80]!r} is not a SHA-256", "Give 64 hexadecimal digits.")
    return text.lower()


def check_image(path: Path, sha256: str) -> Image:
    """The image, if its hash matches and it is a complete MicroPython for a supported chip.

    Raises:
        StorageError: cannot be read.
        FileFormatError: wrong hash, not an image, an application without its bootloader, another chip.
    """
    data = read_bytes(path, _LARGEST)
    actual = hashlib.sha256(data).hexdigest()
    if actual != sha256:
        raise FileFormatError(
            f"{path}: is not the expected image: sha256 {actual}, expected {sha256}",
            "Download it again from micropython.org; the download may be incomplete.",
        )
    source = "Use the .bin for ESP32_GENERIC or ESP32_GENERIC_C3 from micropython.org."
    if len(data) < 48 or data[0] != _MAGIC or not 1 <= data[1] <= 16:
        raise FileFormatError(f"{path}: is not an ESP32 image", source)
    if data[32:36] == _APP_DESCRIPTION:
        raise FileFormatError(
            f"{path}: has no bootloader: it would run with the board's old one, or not at all",
            "Use the complete .bin, not the .app-bin for updates over the air. " + source,
        )
    chip_id = struct.unpack_from("<H", data, 12)[0]
    chip = next((chip for chip in CHIPS.values() if chip.image_id == chip_id), None)
    if chip is None:
        raise FileFormatError(f"{path}: is for an {_NAMES.get(chip_id, f'unknown chip ({chip_id})')}", source)
    if b"MicroPython" not in data and b"micropython" not in data:
        raise FileFormatError(f"{path}: is an image for the {chip.name}, but not MicroPython", source)
    if len(data) < _SMALLEST:
        raise FileFormatError(f"{path}: has only {len(data)} bytes", "Download it again; it is truncated.")
    match = _VERSION.search(data)
    version = (match.group(1) or match.group(2)).decode() if match else ""
    return Image(data, actual, chip, version)


@dataclass(frozen=True)
class Connection:
    """Connection to the chip's loader.

    Attributes:
        baud: baud rate for writing.
        before: how esptool brings the chip into its loader; "no-reset" if BOOT is held by hand.
        stub: whether to load esptool's faster helper into the chip.
    """

    port: str
    baud: int = 460800
    before: str = "default-reset"
    stub: bool = True


@dataclass(frozen=True)
class Flashed:
    """Result: chip, its address, offset and bytes; reading back gave the same data."""

    chip: str
    mac: str
    offset: int
    size: int
    verified: bool


def flash(image: Image, connection: Connection, progress: FlashProgress, erase: bool = False) -> Flashed:
    """Write the image and verify it.

    Args:
        erase: erase the whole flash first, with all earlier bonds, configuration and files.

    Raises:
        PortInUseError, DeviceGoneError, DeviceError: the port.
        DeviceGoneError: no board answers in its loader.
        DeviceRejectedError: the image is for another chip.
        DeviceError: the flash is incomplete, or reads back differently.
    """
    open_port(connection.port, _BAUD, 1.0, "`tagid-firmware verify` without --port lists the ports").close()
    with _esptool(progress) as tool:
        try:
            esp = tool.detect_chip(connection.port, _BAUD, connection.before, connect_attempts=3)
        except Exception as error:
            raise DeviceGoneError(
                f"no board answers on {connection.port}: {_line(error)}",
                "Hold BOOT while pressing RESET (EN), release RESET first, and run this again; "
                "check that the cable carries data.",
            ) from error
        try:
            return _write(tool, esp, image, connection, progress, erase)
        finally:
            with contextlib.suppress(Exception):
                esp._port.close()


def _write(
    tool: Any, esp: Any, image: Image, connection: Connection, progress: FlashProgress, erase: bool
) -> Flashed:
    if image.chip.name != esp.CHIP_NAME:
        raise DeviceRejectedError(
            f"the board on {connection.port} is an {esp.CHIP_NAME}, the image is for an {image.chip.name}",
            f"Use the image for the {esp.CHIP_NAME}, or another board.",
        )
    mac = ":".join(f"{byte:02x}" for byte in esp.read_mac())
    offset = image.chip.offset
    with _half(connection, touched=False):
        if connection.stub:
            esp = tool.run_stub(esp)
            if connection.baud != _BAUD:
                esp.change_baud(connection.baud)
        tool.attach_flash(esp)
    with _half(connection, touched=True):
        if erase:
            progress(0, "erasing")
            tool.erase_flash(esp)
        tool.write_flash(esp, [(offset, image.data)], no_compress=not connection.stub)
        progress(len(image.data), "reading back")
        tool.verify_flash(esp, [(offset, image.data)])
    with contextlib.suppress(Exception):
        tool.reset_chip(esp, "hard-reset" if connection.before != "no-reset" else "no-reset")
    return Flashed(esp.CHIP_NAME, mac, offset, len(image.data), True)


@contextmanager
def _half(connection: Connection, touched: bool) -> Iterator[None]:
    """Convert failures of a chip that answered, with the state of its flash."""
    try:
        yield
    except (KeyboardInterrupt, Exception) as error:
        if not touched:
            if isinstance(error, KeyboardInterrupt):
                raise
            raise DeviceError(
                f"the board on {connection.port} stopped answering: {_line(error)}; nothing was written",
                "Try a slower --baud, another cable or port, or --no-stub.",
            ) from error
        raise DeviceError(
            f"the flash of the board on {connection.port} is incomplete: {_line(error)}",
            "Run the same command again (hold BOOT while pressing RESET if the board does not answer); "
            "it starts from the beginning, whatever the earlier state.",
        ) from error


def _line(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "stopped by the user"
    return str(error).strip().partition("\n")[0] or type(error).__name__


@contextmanager
def _esptool(progress: FlashProgress) -> Iterator[Any]:
    """esptool's functions, its output turned into progress. Raises MissingExtraError."""
    try:
        from esptool import cmds
        from esptool.logger import EsptoolLogger, TemplateLogger
    except ImportError as error:
        raise MissingExtraError("flashing needs esptool", EXTRA) from error

    class Quiet(TemplateLogger):  # type: ignore[misc]
        """Progress is forwarded, text is dropped: failures arrive as exceptions."""

        def print(self, *words: Any, **options: Any) -> None: ...

        note = warning = error = stage = set_verbosity = print

        def progress_bar(
            self, cur_iter: int, total_iters: int, prefix: str = "", suffix: str = "", bar_length: int = 30
        ) -> None:
            progress(cur_iter, f"{100 * cur_iter // max(total_iters, 1)} %")

    # Set on the class, because an installed logger cannot be replaced.
    EsptoolLogger.set_logger(None, Quiet())
    with contextlib.redirect_stdout(io.StringIO()):
        yield cmds
