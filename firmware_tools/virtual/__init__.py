"""The bridge without a board: its unmodified firmware between a pty and a virtual Bluetooth controller."""
