"""The ROM loader of an ESP32 or ESP32-C3 on a pty, as far as esptool needs it to write without its stub.

SLIP frames and commands after Espressif's "Serial Protocol" page of the esptool documentation.
"""

from __future__ import annotations

import hashlib
import os
import struct
import threading
import tty
from types import TracebackType
from typing import Self

_ESP32_REGISTERS = {0x40001000: 0x00F01D83, 0x3FF5A004: 0x33445566, 0x3FF5A008: 0x1122}
_C3_REGISTERS = {0x60008844: 0x33445566, 0x60008848: 0x1122}
_BLOCK = 0x400


def slip(body: bytes) -> bytes:
    return b"\xc0" + body.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


class EspRom:
    """A board waiting in its loader.

    Args:
        chip: "esp32" or "esp32c3".
        dies_after: number of data blocks after which it answers nothing more.
        worn: reads back one bit differently.
    """

    def __init__(self, chip: str = "esp32", dies_after: int | None = None, worn: bool = False) -> None:
        self.chip, self.dies_after, self.worn = chip, dies_after, worn
        self.flash = bytearray(b"\xff" * (4 << 20))
        self.blocks = 0
        self._base = 0
        self._registers = dict(_ESP32_REGISTERS if chip == "esp32" else _C3_REGISTERS)

    def __enter__(self) -> Self:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        tty.setraw(self._master)
        self.path = os.ttyname(self._slave)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._running = True
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._running = False
        os.write(self._slave, b"\xc0")  # wakes the reader
        self._thread.join(10)
        os.close(self._slave)
        os.close(self._master)

    def _serve(self) -> None:
        buffer = b""
        while True:
            data = os.read(self._master, 65536)
            if not self._running:
                return
            buffer += data
            while (start := buffer.find(b"\xc0")) >= 0 and (end := buffer.find(b"\xc0", start + 1)) >= 0:
                packet = buffer[start + 1 : end].replace(b"\xdb\xdc", b"\xc0").replace(b"\xdb\xdd", b"\xdb")
                buffer = buffer[end + 1 :] if packet else buffer[end:]
                if len(packet) >= 8:
                    self._command(packet[1], packet[8:])

    def _reply(self, op: int, value: int = 0, data: bytes = b"", status: bytes = b"\0\0") -> None:
        padding = b"\0\0" if self.chip == "esp32" else b""
        body = data + status + (padding or b"\0\0")
        os.write(self._master, slip(struct.pack("<BBHI", 1, op, len(body), value) + body))

    def _command(self, op: int, body: bytes) -> None:
        if self.dies_after is not None and self.blocks >= self.dies_after:
            return
        if op == 0x08:
            for _ in range(8):
                self._reply(op, 0x20120707)
        elif op == 0x0A:
            self._reply(op, self._registers.get(struct.unpack("<I", body[:4])[0], 0))
        elif op == 0x14 and self.chip == "esp32c3":
            self._reply(op, 0, struct.pack("<IBBBBBBBBII", 0, 0, *[0] * 7, 5, 3))
        elif op == 0x14:
            self._reply(op, 0, b"", b"\x01\x05")
        elif op == 0x02:
            size, _, _, offset = struct.unpack("<IIII", body[:16])
            self._base = offset
            self.flash[offset : offset + size] = b"\xff" * size
            self._reply(op)
        elif op == 0x03:
            size, sequence = struct.unpack("<II", body[:8])
            start = self._base + sequence * _BLOCK
            self.flash[start : start + size] = body[16 : 16 + size]
            self.blocks += 1
            self._reply(op)
        elif op == 0x13:
            address, size = struct.unpack("<II", body[:8])
            data = bytearray(self.flash[address : address + size])
            if self.worn and size:
                data[size // 2] ^= 1
            self._reply(op, 0, hashlib.md5(data).hexdigest().encode())
        elif op == 0x0E:
            address, size = struct.unpack("<II", body[:8])
            self._reply(op, 0, bytes(self.flash[address : address + size]))
        else:
            self._reply(op)
