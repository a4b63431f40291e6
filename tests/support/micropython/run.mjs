// Run a script under MicroPython: node run.mjs PACKAGE SCRIPT TARGET=SOURCE... copies the files before.
import fs from "node:fs";
import { pathToFileURL } from "node:url";

const [, , folder, script, ...files] = process.argv;
const { loadMicroPython } = await import(pathToFileURL(`${folder}/micropython.mjs`).href);
const python = await loadMicroPython({ heapsize: 4 << 20, stdout: (line) => console.log(line) });
for (const file of files) {
  const [target, source] = file.split("=");
  const parts = target.split("/").slice(0, -1);
  parts.forEach((_, k) => {
    const path = "/" + parts.slice(0, k + 1).join("/");
    if (!python.FS.analyzePath(path).exists) python.FS.mkdir(path);
  });
  python.FS.writeFile("/" + target, fs.readFileSync(source));
}
try {
  python.runPython("import os, sys\nos.chdir('/')\nsys.path.insert(0, '/')\n" + fs.readFileSync(script, "utf8"));
} catch (error) {
  console.log(error.message);
  process.exit(1);
}
