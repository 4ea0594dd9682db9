// Runs a script in MicroPython with the files of a folder under /board: node run.mjs FOLDER SCRIPT HEAP_BYTES
import { loadMicroPython } from "@micropython/micropython-webassembly-pyscript/micropython.mjs";
import fs from "node:fs";
import path from "node:path";

const [folder, script, heap] = process.argv.slice(2);
const python = await loadMicroPython({ heapsize: Number(heap), stdout: (line) => console.log(line) });

function copy(from, to) {
  python.FS.mkdir(to);
  for (const entry of fs.readdirSync(from, { withFileTypes: true })) {
    const source = path.join(from, entry.name);
    const target = `${to}/${entry.name}`;
    if (entry.isDirectory()) copy(source, target);
    else python.FS.writeFile(target, fs.readFileSync(source));
  }
}

copy(folder, "/board");
python.runPython(`import sys, os\nsys.path.insert(0, "/board")\nos.chdir("/board")`);
python.runPython(fs.readFileSync(script, "utf8"));

const plans = JSON.parse(fs.readFileSync(path.join(folder, "scenario.json"), "utf8"));
plans.forEach((plan, number) => {
  if (!plan.measure) return;
  python.runPython(`begin(PLANS[${number}])`);
  python.runPython("gc.collect()");
  python.runPython("begin_measured()");
  while (!python.globals.get("ENDED")) {
    python.runPython("tick()");
    python.runPython("gc.collect()");
    python.runPython("sample()");
  }
  python.runPython("end_measured()");
});
