"""`roomba+serial://PORT` and `roomba+ble://NAME-OR-ADDRESS`: creates a robot from a URL."""

from __future__ import annotations

import math
from collections.abc import Callable

from tagid.motion.calibration import recall
from tagid.motion.links import ByteLink, SerialLink
from tagid.motion.roomba.device import HALT, MAX_STEP, Roomba, step_period_s
from tagid.motion.roomba.messages import BAUD_CODES
from tagid.motion.roomba.odometry import NOMINAL_SCALE_SIGMA, SLIP_SIGMA, WHEEL_BASE_MM
from tagid.motion.urls import Options


def _robot(options: Options, open_link: Callable[[], ByteLink], robot: str, fast: bool) -> Roomba:
    step = options.number("step", None, 1, MAX_STEP)
    rpm = options.number("rpm", None, 0.1, 60 / step_period_s(MAX_STEP) + 0.5)
    if step is not None and rpm is not None:
        raise options.wrong("both step and rpm are given")
    if rpm is not None:
        # The nearest speed that the wheels support.
        step = min(range(1, MAX_STEP + 1), key=lambda n: abs(60 / step_period_s(n) - rpm))
    if step is not None and step != int(step):
        raise options.wrong(f"step is {step:g}, expected 1, 2 or 3")
    base = options.number("base_mm", None, 100, 1000)
    known = recall(robot) if base is None and not options.stopping else None
    if known is not None:
        # The floor may differ today: the wheel base is known, the slip is not.
        base, sigma = known.wheel_base_mm, math.hypot(known.sigma, SLIP_SIGMA)
    else:
        sigma = NOMINAL_SCALE_SIGMA
    return Roomba(
        open_link,
        robot,
        step=int(step or 2),
        direction=options.direction(),
        wheel_base_mm=base or WHEEL_BASE_MM,
        scale_sigma=sigma,
        calibrated=known is not None,
        fast=fast,
        turns=options.number("turns", None, 0.01, 20),
        max_seconds=options.number("max_seconds", 300.0, 1, 3600),
    )


def open_serial(options: Options) -> Roomba:
    """A robot on a cable. Options: baud, step or rpm, direction, base_mm, turns, max_seconds."""
    port = options.port()
    baud = int(options.number("baud", 115200, 300, 115200))
    if baud not in BAUD_CODES:
        raise options.wrong(f"baud is {baud}, expected 115200 or 19200")
    return _robot(options, lambda: SerialLink(port, baud, HALT), port, fast=baud == 115200)


def open_ble(options: Options) -> Roomba:
    """A robot behind the Bluetooth bridge. Options as on a cable without baud, plus passkey, hci, wait."""
    from tagid.motion.ble import BridgeLink, ble_address

    address = ble_address(options)
    robot = _robot(options, lambda: BridgeLink(address), address.target, fast=True)
    robot.stops_by = "its bridge stops it within half a second; if it continues to turn, lift it"
    robot.warning = ""
    return robot
