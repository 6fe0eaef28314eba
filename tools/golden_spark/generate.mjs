// Writes ../../fixtures/spark/*.json: inputs, and what the published @sparkjsdev/spark returns for them.
//
//     cd tools/golden_spark && npm ci && npm run generate
//
// Versions are those of package-lock.json: @sparkjsdev/spark 2.2.0, three 0.187.0, @petamoriken/float16 3.9.3.
// Where JavaScript has no Float16Array (node before 24) Spark truncates halves instead of rounding them. Browsers have
// one, so the vectors are made with one: the engine's own, or that of @petamoriken/float16.
// Arrays are little-endian, in base64. Nothing here is random: the same versions write the same bytes.

import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const halves = "Float16Array" in globalThis ? "native" : "@petamoriken/float16";
if (halves !== "native") globalThis.Float16Array = (await import("@petamoriken/float16")).Float16Array;
const spark = await import("@sparkjsdev/spark");
const { encodeSh1Rgb, encodeSh2Rgb, encodeSh3Rgb } = spark.utils;

const here = dirname(fileURLToPath(import.meta.url));
const target = join(here, "..", "..", "fixtures", "spark");
const version = (name) => JSON.parse(readFileSync(join(here, "node_modules", name, "package.json"), "utf8")).version;

const encodings = {
  default: { rgbMin: 0, rgbMax: 1, lnScaleMin: -12, lnScaleMax: 9, sh1Max: 1, sh2Max: 1, sh3Max: 1, lodOpacity: false },
  custom: { rgbMin: -0.5, rgbMax: 1.5, lnScaleMin: -9, lnScaleMax: 3, sh1Max: 0.5, sh2Max: 0.75, sh3Max: 2, lodOpacity: false },
};

let state = 12345; // a linear congruential generator modulo 2^32 (Numerical Recipes)
const random = () => {
  state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
  return Math.fround(state / 4294967296);
};
const between = (low, high) => Math.fround(low + (high - low) * random());

const pick = (values, i) => values[i % values.length];
const scaleEdges = [0, 1e-38, Math.exp(-30), Math.exp(-30) * (1 - 1e-6), Math.exp(-25), Math.exp(-12), Math.exp(-9), Math.exp(3), Math.exp(9), Math.exp(10)];
const colorEdges = [-0.7, -0.002, -0, 0, 0.5 / 255, 1.5 / 255, 0.25, 0.5, 127.5 / 255, 254.5 / 255, 1, 1.002, 1.7];
const centerEdges = [0, -0, 1e-8, -2.9e-8, 5.97e-8, 6.1e-5, 6.09e-5, 1 + 2 ** -11, 1 + 3 * 2 ** -11, -2049, 2051, 65504, 65519, 65520, -70000];
const s = Math.SQRT1_2;
const quatEdges = [
  [0, 0, 0, 1], [0, 0, 0, -1], [0, 0, 0, 0], [-0, -0, -0, -0], [0, 0, 0, 3], [1e-7, 0, 0, 1], [0, 1e-6, 0, 1], [0, 0, -2e-6, 1],
  [1, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, -1, 0], [0, 0, -1, -0], [s, 0, 0, s], [0, -s, 0, s],
  [0, 0, -s, s], [0, 0, -s, -s], [0.5, 0.5, -0.5, 0.5], [-0.5, 0.5, -0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [-0.5, -0.5, -0.5, 0.5],
  [1, 0, -1e-7, 0], [1, -1, -0, 0], [-1, 1, 1e-7, 1e-9], [0, 1, -1, 0], [1, 0, -1, 0], [1e-8, 2e-8, -3e-8, 4e-8], [1e6, -2e6, 3e6, 1e5],
];

const count = 192;
const inputs = {
  center: new Float32Array(count * 3),
  scales: new Float32Array(count * 3),
  quat: new Float32Array(count * 4), // x y z w, as Spark takes it
  opacity: new Float32Array(count),
  rgb: new Float32Array(count * 3),
};
for (let i = 0; i < count; i++) {
  const hasEdges = i < 96; // the first half mixes special values, the second is ordinary
  const length = i % 3 ? 1 : between(0.2, 4);
  const quat = hasEdges && i < 2 * quatEdges.length ? pick(quatEdges, i) : [0, 1, 2, 3].map(() => between(-1, 1) * length);
  inputs.quat.set(quat, i * 4);
  for (let k = 0; k < 3; k++) {
    inputs.center[i * 3 + k] = hasEdges ? pick(centerEdges, i + 4 * k) : between(-50, 50);
    inputs.scales[i * 3 + k] = hasEdges ? pick(scaleEdges, i + 3 * k) : Math.exp(between(-10, 2));
    inputs.rgb[i * 3 + k] = hasEdges ? pick(colorEdges, i + 5 * k) : between(-0.1, 1.1);
  }
  inputs.opacity[i] = hasEdges ? pick(colorEdges, 7 * i) : random();
}

const bands = { sh1: [9, 2, encodeSh1Rgb], sh2: [15, 4, encodeSh2Rgb], sh3: [21, 4, encodeSh3Rgb] };
const rows = 64;
const shEdges = [0, -0, 0.5 / 63, -0.5 / 63, 1.5 / 127, -1.5 / 127, 0.5 / 31, -0.5 / 31, 0.5, -0.5, 1, -1, 1.2, -3];
const shInputs = {};
for (const [name, [width]] of Object.entries(bands)) {
  const values = (shInputs[name] = new Float32Array(rows * width));
  for (let i = 0; i < values.length; i++) values[i] = i < values.length / 2 ? pick(shEdges, i + Math.floor(i / width)) : between(-1.1, 1.1);
}

const outputs = {};
const shOutputs = {};
const decoded = {};
for (const [name, encoding] of Object.entries(encodings)) {
  const packed = new Uint32Array(count * 4);
  for (let i = 0; i < count; i++) {
    spark.setPackedSplat(
      packed, i, ...inputs.center.subarray(i * 3, i * 3 + 3), ...inputs.scales.subarray(i * 3, i * 3 + 3),
      ...inputs.quat.subarray(i * 4, i * 4 + 4), inputs.opacity[i], ...inputs.rgb.subarray(i * 3, i * 3 + 3), encoding,
    );
  }
  outputs[name] = packed;
  decoded[name] = { center: [], scales: [], quat: [], opacity: [], rgb: [] };
  for (let i = 0; i < count; i++) {
    const splat = spark.unpackSplat(packed, i, encoding);
    decoded[name].center.push(...splat.center.toArray());
    decoded[name].scales.push(...splat.scales.toArray());
    decoded[name].quat.push(...splat.quaternion.toArray());
    decoded[name].opacity.push(splat.opacity);
    decoded[name].rgb.push(...splat.color.toArray());
  }
  shOutputs[name] = {};
  for (const [band, [width, words, encode]] of Object.entries(bands)) {
    const array = (shOutputs[name][band] = new Uint32Array(rows * words));
    for (let i = 0; i < rows; i++) encode(array, i, shInputs[band].subarray(i * width, (i + 1) * width), encoding);
  }
}

const base64 = (array) => Buffer.from(array.buffer, array.byteOffset, array.byteLength).toString("base64");
const texts = (value) =>
  ArrayBuffer.isView(value) ? base64(value)
  : Array.isArray(value) ? base64(Float32Array.from(value))
  : Object.fromEntries(Object.entries(value).map(([key, entry]) => [key, texts(entry)]));

const versions = { "@sparkjsdev/spark": version("@sparkjsdev/spark"), three: version("three"), halves: "round to nearest even" };
mkdirSync(target, { recursive: true });
const save = (name, content) => writeFileSync(join(target, name), `${JSON.stringify({ versions, encodings, ...content }, null, 1)}\n`);
save("splats.json", { count, inputs: texts(inputs), packed: texts(outputs) });
save("sh.json", { count: rows, inputs: texts(shInputs), words: texts(shOutputs) });
save("decoded.json", { count, decoded: texts(decoded) });
console.error(`wrote ${count} splats and ${rows} rows of SH to fixtures/spark (halves: ${halves})`);
