"""The bridge without a board: its unmodified firmware with a pty and a virtual Bluetooth controller."""
