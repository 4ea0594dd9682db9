"""Checks a MicroPython image before a board is accessed: its hash, its type, its chip.

Images come from micropython.org; the hash detects an incomplete download and tampering.
"""

from __future__ import annotations

import hashlib
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from firmware_tools.boards import CHIPS, Chip
from tagid.errors import FileFormatError, UsageError
from tagid.files import read_bytes

_LARGEST: Final = 16 << 20
_SMALLEST: Final = 512 << 10
_MAGIC: Final = 0xE9
_APP_DESCRIPTION: Final = struct.pack("<I", 0xABCD5432)
"""Magic word of an application's description, behind the 24 + 8 byte headers (ESP-IDF `esp_app_desc_t`)."""
_NAMES: Final = {0: "ESP32", 2: "ESP32-S2", 5: "ESP32-C3", 9: "ESP32-S3", 12: "ESP32-C2", 13: "ESP32-C6"}
_VERSION: Final = re.compile(rb"MicroPython v?(\d+\.\d+(?:\.\d+)?)|v(1\.\d{2}\.\d+)(?:-\w+)*\x00")


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
