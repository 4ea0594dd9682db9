"""The status that a radar reports, decoded from GET_STATUSINFO into physical units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from tagid.radar.messages import Message

WARM_C: Final = 70.0
"""Board temperature above which to warn (our choice: the end of the commercial temperature range)."""


@dataclass(frozen=True)
class RadarStatus:
    """Answer to GET_STATUSINFO (P440 MRM API).

    Attributes:
        mrm_version, kernel_version: "major.minor.build".
        fpga_version: version and date.
        serial: serial number.
        board_revision: letter of the board.
        built_in_test: 0 if the self test passed.
        temperature_c: board temperature, degrees Celsius.
        package: hardware package, empty on old firmware.
    """

    mrm_version: str
    kernel_version: str
    fpga_version: str
    serial: int
    board_revision: str
    built_in_test: int
    temperature_c: float
    package: str

    def warnings(self) -> list[str]:
        """Warnings for the user, one sentence each: a failed self test, a high temperature."""
        sentences = []
        if self.built_in_test:
            sentences.append(
                f"the self test failed (code {self.built_in_test}): power-cycle the radar; "
                "if it fails again, the unit needs service"
            )
        if self.temperature_c > WARM_C:
            sentences.append(f"board at {self.temperature_c:.1f} degC, above {WARM_C:g}: improve its cooling")
        return sentences


def status_from(message: Message) -> RadarStatus:
    """Decode the status from a GET_STATUSINFO_CONFIRM of either size."""
    m = message
    # The date is binary-coded decimal: 0x16 is the year 16. The temperature is in units of 0.25 degC.
    date = f"20{m['fpga_year']:02x}-{m['fpga_month']:02x}-{m['fpga_day']:02x}"
    return RadarStatus(
        mrm_version=f"{m['mrm_major']}.{m['mrm_minor']}.{m['mrm_build']}",
        kernel_version=f"{m['kernel_major']}.{m['kernel_minor']}.{m['kernel_build']}",
        fpga_version=f"{m['fpga_version']} ({date})",
        serial=m["serial"],
        board_revision=chr(m["board_revision"]) if 32 < m["board_revision"] < 127 else "",
        built_in_test=m["bit_result"],
        temperature_c=m["temperature_quarter_c"] / 4,
        package=_printable(bytes(m.fields["package"]).split(b"\0")[0]),
    )


def _printable(name: bytes) -> str:
    """A name without control characters: text from a radar must not control a terminal."""
    return "".join(c if c.isprintable() else "?" for c in name.decode("ascii", "replace"))
