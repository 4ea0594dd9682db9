"""The configuration file of one bridge: its keys, their bounds, and its parser.

The host tools import this file to check a configuration before it is written, so the two cannot differ.
"""

import json

PATH = "bridge.json"

# key: (default, lowest, highest); None as default means that the feature is off until a value is given.
NUMBERS = {
    "uart_id": (1, 1, 2),
    "uart_tx": (None, 0, 39),
    "uart_rx": (None, 0, 39),
    "baud": (115200, 300, 115200),
    "brc_pin": (None, 0, 39),
    "index_pin": (None, 0, 39),
    "index_gap_ms": (50, 1, 10000),
    "deadman_ms": (400, 100, 5000),
    "watchdog_ms": (1000, 500, 60000),
    "linger_ms": (5, 0, 50),
}
FLAGS = {"brc_inverted": True, "index_rising": False}
NEEDED = ("uart_tx", "uart_rx")


def default():
    """Every key with its default; no pins are set, so nothing can be driven."""
    config = {key: bounds[0] for key, bounds in NUMBERS.items()}
    config.update(FLAGS)
    config["name"] = "tagid-setup"
    config["passkey"] = None
    return config


def check(given):
    """The complete configuration from the keys of a file. Raises ValueError naming the key."""
    if not isinstance(given, dict):
        raise ValueError("the configuration is not a table of keys")
    config = default()
    for key in given:
        if key not in config:
            raise ValueError("unknown key %r" % (key,))
    config.update(given)
    for key, (fallback, low, high) in NUMBERS.items():
        value = config[key]
        if value is None and fallback is None and key not in NEEDED:
            continue
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise ValueError("%s must be a whole number from %d to %d" % (key, low, high))
    for key in FLAGS:
        if not isinstance(config[key], bool):
            raise ValueError("%s must be true or false" % key)
    pins = [config[key] for key in ("uart_tx", "uart_rx", "brc_pin", "index_pin") if config[key] is not None]
    if len(set(pins)) != len(pins):
        raise ValueError("uart_tx, uart_rx, brc_pin and index_pin must be different pins")
    name = config["name"]
    if not isinstance(name, str) or not 1 <= len(name) <= 20 or any(not " " < c <= "~" for c in name):
        raise ValueError("name must have 1 to 20 printable ASCII characters without spaces")
    passkey = config["passkey"]
    digits = isinstance(passkey, str) and len(passkey) == 6 and all("0" <= c <= "9" for c in passkey)
    if passkey is not None and not digits:
        raise ValueError("passkey must be six digits in quotes, or null for a bridge that anyone may use")
    return config


def load(path=PATH):
    """(configuration, problem): problem is None, or why the defaults apply and nothing is driven."""
    try:
        with open(path) as file:
            return check(json.load(file)), None
    except OSError:
        return default(), "no configuration file"
    except ValueError as error:
        return default(), str(error)
