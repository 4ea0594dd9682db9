"""The Bluetooth part of a motion URL: name, pass-key, controller.

The pass-key may stand in the configuration (motion.passkey) or the environment, where nobody reads it over a
shoulder.
"""

from __future__ import annotations

from tagid.config import load_config
from tagid.motion.ble import BleAddress
from tagid.motion.urls import Options


def ble_address(options: Options, default: str = "") -> BleAddress:
    """Take the Bluetooth options of a URL: passkey, hci, wait. Raises UsageError, ConfigError."""
    target = options.target or default
    if not target:
        raise options.wrong("names no device")
    passkey = options.text("passkey") or load_config()["motion.passkey"]
    if passkey is not None and not (len(passkey) == 6 and passkey.isdecimal()):
        raise options.wrong("the pass-key is not six digits")
    seconds = options.number("wait", 5.0, 0.5, 60)
    return BleAddress(target, passkey, options.text("hci"), seconds or 5.0)
