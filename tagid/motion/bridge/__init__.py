"""The host's side of the Bluetooth bridge: its frames, its client, and answering a pass-key prompt.

Who turns a Roomba and who tests a bridge speak to it through this one place.
"""

from tagid.motion.bridge.protocol import (
    INFO,
    NUS,
    BridgeInfo,
    BridgeStatus,
    Event,
    IndexPulse,
    Op,
    Overflow,
    Status,
    Tripped,
)

__all__ = [
    "INFO",
    "NUS",
    "BridgeInfo",
    "BridgeStatus",
    "Event",
    "IndexPulse",
    "Op",
    "Overflow",
    "Status",
    "Tripped",
]
