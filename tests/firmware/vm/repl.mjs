// A board's USB port: MicroPython's prompt on stdin and stdout, for mpremote. Its files live as long as it runs.
import { loadMicroPython } from "@micropython/micropython-webassembly-pyscript/micropython.mjs";
import fs from "node:fs";

const SOFT_RESET = 0x100; // PYEXEC_FORCED_EXIT, what Ctrl-D answers
const python = await loadMicroPython({
  heapsize: 1 << 20,
  linebuffer: false,
  stdout: (data) => fs.writeSync(1, data instanceof Uint8Array ? data : Buffer.from([data])),
});
python.FS.mkdir("/flash");
python.runPython(`
import os, sys
os.chdir("/flash")
class machine:
    def reset(): pass
sys.modules["machine"] = machine
`);
python.replInit();
// The event-driven prompt cannot paste; a board that cannot says so, and mpremote then types.
const PASTE = [0x05, 0x41, 0x01];
let asked = 0;
process.stdin.on("data", (data) => {
  for (const byte of data) {
    if (byte === PASTE[asked]) {
      if (++asked === PASTE.length) {
        asked = 0;
        fs.writeSync(1, "R\0");
      }
      continue;
    }
    asked = 0;
    if (python.replProcessChar(byte) & SOFT_RESET) {
      fs.writeSync(1, "MPY: soft reboot\r\n");
      python.replInit();
    }
  }
});
process.stdin.on("end", () => process.exit(0));
