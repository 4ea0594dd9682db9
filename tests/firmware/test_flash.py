"""esptool, driven by `tagid-firmware flash`, against the ROM loader of a chip on a pty."""

from __future__ import annotations

import fcntl
import hashlib
import os
import random
import struct
from pathlib import Path
from typing import Any

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from tests.firmware.conftest import Command
from tests.firmware.esp32_rom import EspRom

OFFSETS = {"esp32": 0x1000, "esp32c3": 0}


def image(chip_id: int = 0, size: int = 60_000, text: bytes = b"MicroPython v1.27.0 on 2025-12-09") -> bytes:
    """Looks like a complete image: header of a bootloader for the chip, and the text of a MicroPython."""
    random.seed(chip_id)
    header = struct.pack("<BBBBI", 0xE9, 3, 2, 0x20, 0x40080000) + bytes((0xEE, 0, 0, 0))
    data = header + struct.pack("<H", chip_id) + bytes(10) + random.randbytes(1000) + text + b"\0"
    return data + random.randbytes(size - len(data))


@pytest.fixture
def flash(tmp_path: Path, firmware: Command, monkeypatch: pytest.MonkeyPatch):
    """Runs the command on an image and a port; returns exit code, data, and the first error's words."""
    monkeypatch.setattr("firmware_tools.flash._SMALLEST", 50_000)  # a tenth is sent ten times as fast

    def go(data: bytes, port: str, digest: str = "") -> tuple[int, dict[str, Any], str]:
        path = tmp_path / "image.bin"
        path.write_bytes(data)
        words = ["flash", str(path), "--port", port, "--before", "no-reset", "--no-stub"]
        code, document = firmware(*words, "--sha256", digest or hashlib.sha256(data).hexdigest())
        text = " ".join(f"{error['message']} {error['remedy']}" for error in document["errors"])
        return code, document["data"], text

    return go


@pytest.mark.parametrize("chip", ["esp32", "esp32c3"])
def test_an_image_is_written_where_the_chip_starts_and_read_back(flash, chip: str) -> None:
    data = image({"esp32": 0, "esp32c3": 5}[chip])
    with EspRom(chip) as rom:
        code, result, errors = flash(data, rom.path)
        assert code == 0, errors
        offset = OFFSETS[chip]
        assert rom.flash[offset : offset + len(data)] == data
    assert result["verified"] and result["offset"] == offset and result["size"] == len(data)
    assert result["image"]["micropython"] == "1.27.0"
    assert result["mac"] == "11:22:33:44:55:66"


def test_the_wrong_chip_is_told_before_anything_is_written(flash) -> None:
    with EspRom("esp32c3") as rom:
        code, _, text = flash(image(0), rom.path)
        assert code == 4 and "is an ESP32-C3, the image is for an ESP32" in text
        assert rom.blocks == 0


def test_a_board_that_falls_silent_leaves_a_half_written_flash_that_is_told(flash) -> None:
    data = image()
    with EspRom("esp32", dies_after=30) as rom:
        code, _, text = flash(data, rom.path)
        assert code == 4 and "incomplete" in text and "same command again" in text
        # The same command again, with the board back: nothing of the first try is in the way.
        rom.dies_after = None
        code, _, text = flash(data, rom.path)
        assert code == 0, text
        assert rom.flash[0x1000 : 0x1000 + len(data)] == data


def test_a_flash_that_reads_back_differently_is_told(flash) -> None:
    with EspRom("esp32", worn=True) as rom:
        code, _, text = flash(image(), rom.path)
    assert code == 4 and "incomplete" in text


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"<html>404</html>" * 1000, "is not an ESP32 image"),
        (image(9), "is for an ESP32-S3"),
        (image(text=b"some blinking light"), "but not MicroPython"),
        (image(size=49_999), "truncated"),
        (image()[:32] + struct.pack("<I", 0xABCD5432) + image()[36:], "has no bootloader"),
        (b"", "is not an ESP32 image"),
    ],
)
def test_wrong_images(flash, data: bytes, words: str) -> None:
    code, _, text = flash(data, "/dev/null")
    assert code == 1 and words in text


def test_the_hash_decides(flash, firmware: Command, tmp_path: Path) -> None:
    code, _, text = flash(image(), "/dev/null", digest="0" * 64)
    assert code == 1 and "is not the expected image" in text
    code, _, text = flash(image(), "/dev/null", digest="abc")
    assert code == 2 and "not a SHA-256" in text
    path = tmp_path / "image.bin"
    code, document = firmware("flash", str(path), "--port", "/dev/null")
    assert code == 2 and hashlib.sha256(image()).hexdigest() in document["errors"][0]["message"]
    path.with_name("image.bin.sha256").write_text("0" * 64 + "  image.bin\n")
    code, document = firmware("flash", str(path), "--port", "/dev/null")
    assert code == 1 and "expected 0000" in document["errors"][0]["message"]


def test_ports_that_cannot_be_used(flash, tmp_path: Path) -> None:
    code, _, text = flash(image(), str(tmp_path / "ttyUSB9"))
    assert code == 4 and "no serial port" in text
    master, slave = os.openpty()
    try:
        fcntl.flock(slave, fcntl.LOCK_EX)
        code, _, text = flash(image(), os.ttyname(slave))
        assert code == 4 and "in use by another program" in text
        fcntl.flock(slave, fcntl.LOCK_UN)
        code, _, text = flash(image(), os.ttyname(slave))
        assert code == 4 and "no board answers" in text and "BOOT" in text
    finally:
        os.close(slave)
        os.close(master)


def test_no_board_and_several(firmware: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def plugged(*devices: tuple[str, int, int]) -> None:
        results = []
        for path, vid, pid in devices:
            item = ListPortInfo(path)
            item.vid, item.pid = vid, pid
            results.append(item)
        monkeypatch.setattr(list_ports, "comports", lambda: results)

    data = image(size=600_000)
    (tmp_path / "image.bin").write_bytes(data)
    words = ("flash", str(tmp_path / "image.bin"), "--sha256", hashlib.sha256(data).hexdigest())
    plugged(("/dev/ttyACM5", 0x1209, 1))
    code, document = firmware(*words)
    message = document["errors"][0]["message"]
    assert code == 4 and "no board is connected (USB serial ports: /dev/ttyACM5)" in message
    plugged(("/dev/ttyUSB1", 0x1A86, 0x7523), ("/dev/ttyUSB0", 0x10C4, 0xEA60))
    code, document = firmware(*words)
    assert code == 2 and "/dev/ttyUSB0 (CP210x), /dev/ttyUSB1 (CH340)" in document["errors"][0]["message"]
