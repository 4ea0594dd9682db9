"""How emulated radars differ: the identity that a unit reports, and variants of its firmware.

Clients meet old and new firmware; each difference here is documented or known from public clients.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

from tagid.errors import UsageError
from tagid.radar.messages import MessageType, encode, encode_older
from tagid.radar.settings import RadarConfig

SERVER_ONLY: Final = (
    MessageType.SERVER_CONNECT_REQUEST,
    MessageType.SERVER_DISCONNECT_REQUEST,
    MessageType.SET_FILTER_REQUEST,
    MessageType.GET_FILTER_REQUEST,
)
"""Requests answered by the vendor's PC server program, but by no radar."""


@dataclass(frozen=True)
class Identity:
    """What the emulated radar reports in GET_STATUSINFO.

    Attributes:
        package: name of the hardware package, up to 32 characters.
        temperature_c: board temperature, degrees Celsius.
        boot_s: time from a reboot to READY_INFO (7 s on Ethernet, measured).
        bit_result: result of the built-in test, 0 is healthy.
        clock_ppm: error of its clock.
    """

    serial: int = 0x440
    package: str = "P440 emulator"
    temperature_c: float = 41.25
    boot_s: float = 7.0
    bit_result: int = 0
    clock_ppm: float = 0.0


@dataclass(frozen=True)
class Firmware:
    """Behaviour of one firmware version.

    Attributes:
        status_bytes: size of the status confirm: 64, or 32 on old firmware (no package name).
        sleep_confirm_bytes: size of the GET_SLEEPMODE confirm: 12, or 8 as in the vendor's headers.
        server: answers the requests of the vendor's server program, which a radar refuses with F10C.
        residual_scans: scans that are still sent before the confirm of a stop.
        window_step_ps: the scan window is rounded to multiples of this, in addition to the radar's own grid.
    """

    status_bytes: int = 64
    sleep_confirm_bytes: int = 12
    server: bool = False
    residual_scans: int = 0
    window_step_ps: int = 1

    def __post_init__(self) -> None:
        if self.status_bytes not in (32, 64):
            raise UsageError(f"the status confirm has {self.status_bytes} bytes", "Give 64 or 32.")
        if self.sleep_confirm_bytes not in (8, 12):
            raise UsageError(f"the sleep confirm has {self.sleep_confirm_bytes} bytes", "Give 12 or 8.")

    def take(self, config: RadarConfig) -> RadarConfig:
        """The settings in force after a request for these. Raises ConfigError."""
        step = self.window_step_ps
        if step == 1:
            return config.quantised()
        start = config.scan_start_ps // step * step
        stop = -(-config.scan_stop_ps // step) * step
        return replace(config, scan_start_ps=start, scan_stop_ps=stop).quantised()

    def status_info(self, message_id: int, identity: Identity) -> bytes:
        fields: dict[str, Any] = {
            "mrm_major": 2,
            "mrm_minor": 1,
            "mrm_build": 440,
            "kernel_major": 1,
            "fpga_version": 1,
            "fpga_year": 0x16,
            "fpga_month": 0x12,
            "fpga_day": 0x31,
            "serial": identity.serial,
            "board_revision": ord("C"),
            "bit_result": identity.bit_result,
            "temperature_quarter_c": round(identity.temperature_c * 4),
        }
        if self.status_bytes == 32:
            return encode_older(MessageType.GET_STATUSINFO_CONFIRM, message_id, **fields)
        package = identity.package.encode("ascii", "replace")[:32]
        return encode(MessageType.GET_STATUSINFO_CONFIRM, message_id, package=package, **fields)

    def sleep_mode(self, message_id: int, mode: int) -> bytes:
        pack = encode if self.sleep_confirm_bytes == 12 else encode_older
        return pack(MessageType.GET_SLEEPMODE_CONFIRM, message_id, mode=mode)
