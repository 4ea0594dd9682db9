"""The host side of the Bluetooth bridge: its frames, its client, and the answer to a pass-key prompt."""
