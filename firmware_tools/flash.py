"""Writes a verified image with esptool and reads it back; an incomplete flash is reported as such."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

from firmware_tools.build import EXTRA
from firmware_tools.image import Image
from tagid.errors import DeviceError, DeviceGoneError, DeviceRejectedError, MissingExtraError
from tagid.ports import open_port

_BAUD: Final = 115200
FlashProgress = Callable[[float, str], None]


@dataclass(frozen=True)
class Connection:
    """Connection to the chip's loader.

    Attributes:
        port: device file.
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
        esp = _connect(tool, connection)
        try:
            return _write(tool, esp, image, connection, progress, erase)
        finally:
            with contextlib.suppress(Exception):
                esp._port.close()


def _connect(tool: Any, connection: Connection) -> Any:
    try:
        return tool.detect_chip(connection.port, _BAUD, connection.before, connect_attempts=3)
    except Exception as error:
        raise DeviceGoneError(
            f"no board answers on {connection.port}: {_line(error)}",
            "Hold BOOT while pressing RESET (EN), release RESET first, and run this again; "
            "check that the cable carries data.",
        ) from error


def _write(
    tool: Any, esp: Any, image: Image, connection: Connection, progress: FlashProgress, erase: bool
) -> Flashed:
    if image.chip.name != esp.CHIP_NAME:
        raise DeviceRejectedError(
            f"the board on {connection.port} is an {esp.CHIP_NAME}, the image is for an {image.chip.name}",
            f"Use the image for the {esp.CHIP_NAME}, or another board.",
        )
    mac = ":".join(f"{byte:02x}" for byte in esp.read_mac())
    if connection.stub:
        with _half(connection, touched=False):
            esp = tool.run_stub(esp)
            if connection.baud != _BAUD:
                esp.change_baud(connection.baud)
    offset = image.chip.offset
    with _half(connection, touched=False):
        tool.attach_flash(esp)
    with _half(connection, touched=True):
        if erase:
            progress(0, "erasing")
            tool.erase_flash(esp)
        tool.write_flash(esp, [(offset, image.data)], no_compress=not connection.stub)
    progress(len(image.data), "reading back")
    with _half(connection, touched=True):
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
