"""Firmware of the bridge between Bluetooth LE and a robot's serial port, for MicroPython on ESP32 and C3."""

VERSION = (1, 1, 1)
PROTOCOL = 2
