"""The Bluetooth part of a motion URL: name, pass-key, controller.

The pass-key may be given in the configuration (motion.passkey) or the environment, where it does not appear
on the command line.
"""

from __future__ import annotations

import os
from pathlib import Path

from tagid.config import load_config
from tagid.errors import ConfigError
from tagid.motion.ble import BleAddress
from tagid.motion.urls import Options
from tagid.secret import MotionUrl, Secret


def _refuse_a_readable_file(path: Path) -> None:
    """Raise ConfigError if others can read the file that holds the pass-key."""
    if os.name == "posix" and path.exists() and path.stat().st_mode & 0o077:
        raise ConfigError(
            f"{path} holds the bridge's pass-key and other users can read it", f"Run: chmod 600 {path}"
        )


def ble_address(options: Options, default: str = "") -> BleAddress:
    """Take the Bluetooth options of a URL: passkey, hci, wait. Raises UsageError, ConfigError."""
    target = options.target or default
    if not target:
        raise options.wrong("has no device name")
    config = load_config(tolerant=options.stopping)
    passkey = options.secret() or config["motion.passkey"]
    stored = [config.values[name] for name in ("motion.url", "motion.passkey")]
    in_file = any(setting.source == "file" and _holds_key(setting.value) for setting in stored)
    if passkey is not None and in_file and not options.stopping:
        _refuse_a_readable_file(config.path)
    digits = "" if passkey is None else passkey.reveal()
    if passkey is not None and not (len(digits) == 6 and digits.isascii() and digits.isdecimal()):
        if not options.stopping:
            raise options.wrong("the pass-key is not six digits")
        passkey = None
    seconds = options.number("wait", 5.0, 0.5, 60)
    return BleAddress(target, passkey, options.text("hci"), seconds or 5.0)


def _holds_key(value: Secret) -> bool:
    return value.holds_key if isinstance(value, MotionUrl) else True
