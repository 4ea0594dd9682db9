"""The host side of the Bluetooth bridge: its frames, its client, and the answer to a pass-key prompt.

Motion devices and bridge tests both use this package to talk to a bridge.
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
