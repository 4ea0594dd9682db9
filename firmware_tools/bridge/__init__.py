"""Files for the board: `main.py` and the folder `tagid_bridge`; this file stays on the host."""
