"""Started by MicroPython at power-up; everything else is compiled, only this file must be source."""

import tagid_bridge.control

tagid_bridge.control.run()
