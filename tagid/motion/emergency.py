"""`python -m tagid.motion.emergency`: with it a guardian stops a device that has no port to share.

The device's URL comes on standard input, because every user can read command lines and a URL may hold a
pass-key. The guardian is not involved: it waits for this command.
"""

from __future__ import annotations

import logging
import sys
import time
from typing import Final

from tagid.errors import EXIT_DEVICE, DeviceError, TagidError
from tagid.motion.driven import DrivenMotion
from tagid.motion.urls import open_motion

_TRIES: Final = 3
_PAUSE_S: Final = 2.0


def stop(url: str) -> None:
    """Connect to a device and stop it. Raises DeviceError if it does not confirm after some tries."""
    device = open_motion(url, stopping=True)
    if not isinstance(device, DrivenMotion):
        return
    for attempt in range(_TRIES):
        try:
            device.halt_directly()
            return
        except DeviceError:
            if attempt == _TRIES - 1:
                raise
            logging.getLogger("tagid").debug("stopping", exc_info=True)
            time.sleep(_PAUSE_S)


if __name__ == "__main__":
    try:
        stop(sys.stdin.readline().rstrip("\n"))
    except TagidError as error:
        sys.stderr.write(f"tagid: {error.message}. {error.remedy}\n")
        sys.exit(EXIT_DEVICE)
