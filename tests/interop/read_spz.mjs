// Reads SPZ files with the format's own WebAssembly build: node read_spz.mjs MODULE FILE SYSTEM OUTPUT
// OUTPUT gets a JSON header line, then positions, scales, rotations (x y z w), alphas, colors and SH as float32.
import { readFileSync, writeFileSync } from 'node:fs';
import { pathToFileURL } from 'node:url';

const [module, file, system, output] = process.argv.slice(2);
const { default: create } = await import(pathToFileURL(module).href);
const spz = await create();
const cloud = spz.loadSpzFromBuffer(new Uint8Array(readFileSync(file)), { to: spz.CoordinateSystem[system] });
const arrays = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'].map((name) => new Float32Array(cloud[name]));
const header = {
  count: cloud.numPoints,
  degree: cloud.shDegree,
  antialiased: cloud.antialiased,
  extensions: spz.SpzHasExtensionSupport(),
  lengths: arrays.map((values) => values.length),
};
const parts = [Buffer.from(JSON.stringify(header) + '\n'), ...arrays.map((a) => Buffer.from(a.buffer, a.byteOffset, a.byteLength))];
writeFileSync(output, Buffer.concat(parts));
process.exit(0);
