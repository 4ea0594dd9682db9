"""The Bluetooth bridge between a computer and a robot's serial port: its firmware and its tools."""
