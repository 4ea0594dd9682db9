"""A floor robot as a turntable: the Roomba's Open Interface, its odometry, and its safety functions.

Opcodes and packets are those of iRobot's "Create 2 Open Interface (OI) Specification".
"""

from tagid.motion.roomba.client import OpenInterface, RobotStatus
from tagid.motion.roomba.messages import Mode, Packet
from tagid.motion.roomba.odometry import SpinOdometry
from tagid.motion.roomba.stream import StreamDecoder

__all__ = ["Mode", "OpenInterface", "Packet", "RobotStatus", "SpinOdometry", "StreamDecoder"]
