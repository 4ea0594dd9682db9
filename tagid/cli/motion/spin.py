"""`tagid motion spin`: rotate without a radar, as a check."""

from __future__ import annotations

import math
import time
from typing import Annotated

import typer

from tagid.cli.common.consent import Yes, agree
from tagid.cli.common.frame import Terminal, command
from tagid.cli.motion.device import Url, driven, facts_table
from tagid.errors import UsageError
from tagid.result import Result

_LOOK_S = 0.05


def register(group: typer.Typer) -> None:
    """Add the command."""

    @command(group, "motion spin")
    def spin(
        terminal: Terminal,
        url: Url = None,
        turns: Annotated[float, typer.Option("--turns", help="Number of revolutions, 0.01 to 20.")] = 1.0,
        yes: Yes = False,
    ) -> Result:
        """Rotate by a number of revolutions and stop.

        Example: tagid motion spin roomba+serial:///dev/ttyUSB1 --turns 0.5
        """
        if not 0.01 <= turns <= 20:
            raise UsageError(f"--turns is {turns}", "Give 0.01 to 20.")
        device = driven(url)
        device.turns = turns
        way = "clockwise" if device.direction < 0 else "counter-clockwise"
        agree(
            f"{device.name} will rotate {way} by {turns:g} revolutions, {device.nominal_s:.0f} s each",
            yes,
            device.warning,
        )
        begin = time.monotonic()
        with terminal.progress("turn", turns) as advance:
            try:
                device.start()
                while not device.finished([], []):
                    device.check()
                    done = abs(device.turned_rad) / (2 * math.pi)
                    advance(done, f"{done * 360:.0f} degrees")
                    time.sleep(_LOOK_S)
            finally:
                device.stop()
        track = device.track()
        facts = {
            "turned_deg": math.degrees(device.turned_rad),
            "sigma_deg": math.degrees(
                math.hypot(float(track.sigma_rad[-1]), device.scale_sigma * device.turned_rad)
            ),
            "seconds": time.monotonic() - begin,
            "readings": len(track),
            **track.info,
        }
        return Result("motion spin", facts, facts_table(facts))
