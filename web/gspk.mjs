/**
 * Reads .gspk packs (docs/formats/gspk.md, version 1) and hands the Spark layout to Spark's PackedSplats.
 *
 * A plain ES module: no build step, nothing imported. Zstandard frames are decompressed by a function that the caller
 * passes in, such as `decompress` of the npm package fzstd; files written with codec `none` need none.
 *
 *   import * as spark from "@sparkjsdev/spark";
 *   import { decompress } from "fzstd";
 *   import { loadGspk, toSplatMesh } from "./gspk.mjs";
 *   scene.add(toSplatMesh(spark, await loadGspk("scene.gspk", { decompress })));
 */

const VERSION = 1;
const HEADER_BYTES = 64;
const ALIGNMENT = 64;
const LAYOUTS = ["spark", "uncompressed"];
const MAX_JSON_BYTES = 64 * 2 ** 20;
const MAX_RATIO = 1024; // decoded bytes for each byte of the file

// Spark's textures are 2048 wide; beyond 2048 rows they grow by whole layers.
const TEXTURE_WIDTH = 2048;
const TEXTURE_LAYER = 2048 * 2048;

// prettier-ignore
const DEFAULT_ENCODING = {
  rgbMin: 0, rgbMax: 1, lnScaleMin: -12, lnScaleMax: 9, sh1Max: 1, sh2Max: 1, sh3Max: 1, sh4Max: 1,
};

const MOTION = { velocities: ["f32", 3], times: ["f32"], durations: ["f32"] };

/** Something in the bytes is wrong: `field` names it as the specification does, `offset` is the byte in the file. */
export class GspkError extends Error {
  constructor(message, { field, offset, cause } = {}) {
    const place = [field, offset === undefined ? undefined : `byte ${offset}`].filter((part) => part !== undefined);
    super(place.length ? `${place.join(", ")}: ${message}` : message, { cause });
    this.name = "GspkError";
    this.field = field;
    this.offset = offset;
  }
}

/**
 * Fetch a pack and read it.
 *
 * @param {string | URL | Request} source what fetch takes
 * @param {object} [options] those of readGspk, and `fetchOptions` for fetch
 */
export async function loadGspk(source, { fetchOptions, ...options } = {}) {
  const response = await fetch(source, fetchOptions);
  if (!response.ok) throw new Error(`${response.url || source}: the server answered ${response.status} ${response.statusText}`);
  return readGspk(await response.arrayBuffer(), options);
}

/**
 * Read a whole pack.
 *
 * @param {ArrayBuffer | Uint8Array} source the file's bytes
 * @param {object} [options]
 * @param {(frame: Uint8Array, target: Uint8Array) => Uint8Array | Promise<Uint8Array>} [options.decompress]
 *   decompresses one Zstandard frame, into `target` or into an array of its own; fzstd's `decompress` as it is
 * @param {boolean} [options.verify] compare the checksums of the arrays, default true
 * @returns {Promise<object>}
 *   layout, count, degree, bounds ({min, max} or null), origin, coordinateSystem, splatModel, description (the file's JSON) and
 *   - layout "spark": numSplats, packedArray (Uint32Array, padded with zeros to whole texture rows), extra ({sh1, sh2, sh3},
 *     those that there are), splatEncoding: the arguments of Spark's PackedSplats; sh4 where the degree is 4, which Spark has not
 *   - layout "uncompressed": positions, colors, scales, rotations, shs (Float32Array; shs only from degree 1)
 *   - motion ({velocities, times, durations, timeModel}) or null
 *   Arrays stored with codec `none` are views of `source` wherever they need no padding.
 * @throws {GspkError} the bytes are no pack, are damaged, or need a decompressor that was not given
 */
export async function readGspk(source, { decompress, verify = true } = {}) {
  const bytes = source instanceof Uint8Array ? source : new Uint8Array(source);
  const { description, parts, text } = readDescription(bytes);
  const { layout, count, degree } = description;
  const motion = Object.keys(MOTION).some((name) => parts.has(name));
  const expected = expectedStreams(layout, degree, motion);

  const wrong = (message) => new GspkError(message, { field: "streams" });
  let decodedBytes = 0;
  for (const [name, [dtype, ...rest]] of Object.entries(expected)) {
    const stream = parts.get(name);
    if (!stream) throw wrong(`layout ${layout}, degree ${degree} needs a stream ${name}, and the file has none`);
    checkStream(stream, { dtype, shape: [count, ...rest], bytes, frameRows: description.frame_rows });
    decodedBytes += stream.raw_length;
  }
  checkApart([text, ...Object.keys(expected).map((name) => parts.get(name))]);
  if (decodedBytes > MAX_RATIO * bytes.length) {
    throw wrong(`the file claims ${decodedBytes} decoded bytes, more than ${MAX_RATIO} times its ${bytes.length} bytes`);
  }

  const arrays = {};
  for (const [name, [dtype]] of Object.entries(expected)) {
    const rows = layout === "spark" && name !== "sh4" && !(name in MOTION) ? paddedCount(count) : count;
    arrays[name] = await readStream(parts.get(name), { bytes, rows, dtype, description, decompress, verify });
  }

  const pack = {
    layout,
    count,
    degree,
    bounds: description.bounds ?? null,
    origin: description.origin ?? [0, 0, 0],
    coordinateSystem: description.coordinate_system ?? "unknown",
    splatModel: description.splat_model ?? "default",
    motion: null,
    description,
  };
  if (motion) {
    const { velocities, times, durations } = arrays;
    pack.motion = { velocities, times, durations, timeModel: description.time_model };
  }
  if (layout === "spark") {
    const { packed, sh1, sh2, sh3, sh4 } = arrays;
    const extra = Object.fromEntries(Object.entries({ sh1, sh2, sh3 }).filter(([, words]) => words));
    const splatEncoding = readEncoding(description);
    Object.assign(pack, { numSplats: count, packedArray: packed, extra, splatEncoding }, sh4 ? { sh4 } : {});
  } else {
    const { positions, colors, scales, rotations, shs } = arrays;
    Object.assign(pack, { positions, colors, scales, rotations }, shs ? { shs } : {});
  }
  return pack;
}

/**
 * Spark's PackedSplats from a pack.
 *
 * @param {object} spark the module @sparkjsdev/spark
 * @param {object} pack what readGspk returned
 */
export function toPackedSplats(spark, pack) {
  if (pack.layout !== "spark") {
    throw new Error(
      `PackedSplats takes layout spark, this pack has layout ${pack.layout}: write it with gsplat-convert --to spark`,
    );
  }
  const { packedArray, numSplats, extra, splatEncoding } = pack;
  return new spark.PackedSplats({ packedArray, numSplats, extra: { ...extra }, splatEncoding });
}

/**
 * A SplatMesh that draws a pack. It is not moved: `pack.origin` and `pack.coordinateSystem` are the caller's to apply.
 *
 * @param {object} spark the module @sparkjsdev/spark
 * @param {object} pack what readGspk returned
 * @param {object} [options] further options of SplatMesh
 */
export function toSplatMesh(spark, pack, options = {}) {
  // Spark 2.2 replaces the encoding of the PackedSplats that a SplatMesh is given by its own option, or by the defaults.
  return new spark.SplatMesh({ ...options, packedSplats: toPackedSplats(spark, pack), splatEncoding: pack.splatEncoding });
}

/** Splats that Spark's textures hold where `count` are wanted: whole rows, and whole layers once there are several. */
export function paddedCount(count) {
  const unit = count > TEXTURE_LAYER ? TEXTURE_LAYER : TEXTURE_WIDTH;
  return Math.max(1, Math.ceil(count / unit)) * unit;
}

function readDescription(bytes) {
  const { length } = bytes;
  const view = new DataView(bytes.buffer, bytes.byteOffset, length);
  const wrong = (field, offset, message) => new GspkError(message, { field, offset });
  const readU64 = (at, field) => {
    const value = Number(view.getBigUint64(at, true));
    if (!Number.isSafeInteger(value)) throw wrong(field, at, `${value} is beyond 2^53`);
    return value;
  };
  if (length < 4 || String.fromCharCode(...bytes.subarray(0, 4)) !== "GSPK") {
    throw wrong("magic", 0, "the file does not start with GSPK: it is no .gspk pack");
  }
  if (length < HEADER_BYTES) throw wrong("header", 0, `the header has ${HEADER_BYTES} bytes, the file only ${length}`);
  const version = view.getUint32(4, true);
  if (version !== VERSION) throw wrong("version", 4, `version ${version} is not read here, only ${VERSION}`);
  const fileLength = readU64(8, "file_length");
  if (fileLength !== length) {
    throw wrong("file_length", 8, `the header promises ${fileLength} bytes, the file has ${length}`);
  }
  const offset = readU64(16, "json_offset");
  const size = readU64(24, "json_length");
  if (offset < HEADER_BYTES) throw wrong("json_offset", 16, `expected at least ${HEADER_BYTES}, found ${offset}`);
  if (size > MAX_JSON_BYTES) throw wrong("json_length", 24, `at most ${MAX_JSON_BYTES} bytes are read, found ${size}`);
  if (offset + size > length) throw wrong("json_length", 24, `the description ends at byte ${offset + size} of ${length}`);
  for (let i = 40; i < HEADER_BYTES; i++) {
    if (bytes[i] !== 0) throw wrong("reserved", i, `expected 0, found ${bytes[i]}`);
  }
  const json = bytes.subarray(offset, offset + size);
  checkCrc(json, view.getUint32(32, true), { field: "json_crc32", offset: 32 });
  let description;
  try {
    description = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(json));
  } catch (cause) {
    throw new GspkError(`the description is no JSON: ${cause.message}`, { field: "description", offset, cause });
  }
  const parts = checkDescription(description, offset);
  const layout = view.getUint32(36, true);
  if (LAYOUTS[layout] !== description.layout) {
    throw wrong("layout", 36, `${layout} does not stand for the description's layout ${description.layout}`);
  }
  return { description, parts, text: { name: "description", offset, stored_length: size } };
}

/** Check what concerns the whole file and return the streams by name. */
function checkDescription(description, offset) {
  const wrong = (field, message) => new GspkError(message, { field, offset });
  if (description === null || typeof description !== "object") throw wrong("description", "expected an object");
  const { layout, count, degree, frame_rows: frameRows, streams } = description;
  if (!LAYOUTS.includes(layout)) throw wrong("layout", `expected ${LAYOUTS.join(" or ")}, found ${JSON.stringify(layout)}`);
  if (!isCount(count)) throw wrong("count", `expected a count, found ${JSON.stringify(count)}`);
  if (!isCount(degree) || degree > 4) throw wrong("degree", `expected 0 to 4, found ${JSON.stringify(degree)}`);
  if (!isCount(frameRows) || frameRows < 1)
    throw wrong("frame_rows", `expected at least 1, found ${JSON.stringify(frameRows)}`);
  if (!Array.isArray(streams)) throw wrong("streams", "expected a list");
  const parts = new Map();
  for (const stream of streams) {
    if (typeof stream?.name !== "string") throw wrong("streams", "a stream has no name");
    if (parts.has(stream.name)) throw wrong("streams", `${stream.name} is there twice`);
    parts.set(stream.name, stream);
  }
  return parts;
}

function expectedStreams(layout, degree, motion) {
  const expected =
    layout === "spark"
      ? { packed: ["u32", 4], sh1: ["u32", 2], sh2: ["u32", 4], sh3: ["u32", 4], sh4: ["u32", 4] }
      : {
          positions: ["f32", 3],
          colors: ["f32", 4],
          scales: ["f32", 3],
          rotations: ["f32", 4],
          shs: ["f32", (degree + 1) ** 2 - 1, 3],
        };
  for (const name of ["sh1", "sh2", "sh3", "sh4"]) {
    if (degree < Number(name[2])) delete expected[name];
  }
  if (degree === 0) delete expected.shs;
  return motion ? { ...expected, ...MOTION } : expected;
}

function checkStream(stream, { dtype, shape, bytes, frameRows }) {
  const { name: field, offset, raw_length: raw, stored_length: stored, codec, frames, crc32: sums } = stream;
  const wrong = (message) => new GspkError(message, { field, offset: isCount(offset) ? offset : undefined });
  if (stream.dtype !== dtype) throw wrong(`expected dtype ${dtype}, found ${JSON.stringify(stream.dtype)}`);
  if (JSON.stringify(stream.shape) !== JSON.stringify(shape)) {
    throw wrong(`expected shape ${JSON.stringify(shape)}, found ${JSON.stringify(stream.shape)}`);
  }
  const needed = 4 * shape.reduce((product, length) => product * length, 1);
  if (raw !== needed) throw wrong(`raw_length is ${JSON.stringify(raw)}, the shape needs ${needed} bytes`);
  if (!isCount(offset) || offset < HEADER_BYTES || offset % ALIGNMENT !== 0) {
    throw wrong(`offset ${JSON.stringify(offset)} is no multiple of ${ALIGNMENT} behind the header`);
  }
  if (!isCount(stored) || offset + stored > bytes.length) {
    throw wrong(`the stream has ${JSON.stringify(stored)} bytes from byte ${offset}, the file ends at ${bytes.length}`);
  }
  if (codec !== "none" && codec !== "zstd") throw wrong(`expected codec none or zstd, found ${JSON.stringify(codec)}`);
  if (codec === "none" && stored !== raw) throw wrong(`codec none stores ${raw} bytes as they are, stored_length is ${stored}`);
  const numFrames = Math.ceil(shape[0] / frameRows);
  if (!Array.isArray(frames) || frames.length !== numFrames || !frames.every(isCount)) {
    throw wrong(`expected ${numFrames} frames of ${frameRows} rows, found ${JSON.stringify(frames?.length)}`);
  }
  const sum = frames.reduce((total, length) => total + length, 0);
  if (sum !== stored) throw wrong(`the frames add up to ${sum} bytes, stored_length is ${stored}`);
  if (!Array.isArray(sums) || sums.length !== numFrames)
    throw wrong(`expected ${numFrames} checksums, found ${JSON.stringify(sums?.length)}`);
}

function checkApart(stretches) {
  const sorted = stretches.filter((stretch) => stretch.stored_length > 0).sort((a, b) => a.offset - b.offset);
  for (let i = 1; i < sorted.length; i++) {
    if (sorted[i - 1].offset + sorted[i - 1].stored_length > sorted[i].offset) {
      throw new GspkError(`it overlaps ${sorted[i - 1].name}`, { field: sorted[i].name, offset: sorted[i].offset });
    }
  }
}

/** One array with `rows` rows, of which the file has the first `count`. */
async function readStream(stream, { bytes, rows, dtype, description, decompress, verify }) {
  const { count, frame_rows: frameRows } = description;
  const ArrayType = dtype === "f32" ? Float32Array : Uint32Array;
  const { name: field, codec, raw_length: raw } = stream;
  const rowBytes = count === 0 ? 4 * stream.shape.slice(1).reduce((product, length) => product * length, 1) : raw / count;
  const stored = bytes.subarray(stream.offset, stream.offset + stream.stored_length);
  if (codec === "zstd" && raw > 0 && !decompress) {
    throw new GspkError("the stream is compressed: pass a `decompress` for Zstandard frames, such as fzstd's", {
      field,
      offset: stream.offset,
    });
  }
  const isUsableAsItIs = codec === "none" && rows === count && stored.byteOffset % 4 === 0;
  const target = isUsableAsItIs ? stored : new Uint8Array(rows * rowBytes);
  let start = 0;
  for (let i = 0; i < stream.frames.length; i++) {
    const offset = stream.offset + start;
    const frame = stored.subarray(start, (start += stream.frames[i]));
    const part = target.subarray(i * frameRows * rowBytes, Math.min((i + 1) * frameRows, count) * rowBytes);
    if (codec === "zstd") {
      await decompressInto(part, frame, decompress, { field, offset });
    } else if (frame.length !== part.length) {
      throw new GspkError(`frame ${i} has ${frame.length} bytes, its rows need ${part.length}`, { field, offset });
    } else if (!isUsableAsItIs) {
      part.set(frame);
    }
    if (verify) checkCrc(part, stream.crc32[i], { field, offset });
  }
  return new ArrayType(target.buffer, target.byteOffset, (rows * rowBytes) / 4);
}

async function decompressInto(part, frame, decompress, place) {
  const size = frameContentSize(frame);
  if (size !== part.length) {
    throw new GspkError(`a Zstandard frame of ${part.length} bytes is expected, this one states ${size ?? "no size"}`, place);
  }
  let result;
  try {
    result = await decompress(frame, part);
  } catch (cause) {
    throw new GspkError(`the Zstandard frame does not decompress: ${cause?.message ?? cause}`, { ...place, cause });
  }
  if (result.length !== part.length) {
    throw new GspkError(`the Zstandard frame holds ${result.length} bytes, its rows need ${part.length}`, place);
  }
  const isInPlace = result.buffer === part.buffer && result.byteOffset === part.byteOffset;
  if (!isInPlace) part.set(result);
}

/** The content size that a Zstandard frame states (RFC 8878, 3.1.1.1), or undefined: known before anything is allocated. */
function frameContentSize(frame) {
  const view = new DataView(frame.buffer, frame.byteOffset, frame.length);
  if (frame.length < 6 || view.getUint32(0, true) !== 0xfd2fb528) return undefined;
  const descriptor = frame[4];
  const isSingleSegment = (descriptor & 0x20) !== 0;
  const sizeFlag = descriptor >> 6;
  const at = 5 + (isSingleSegment ? 0 : 1) + [0, 1, 2, 4][descriptor & 3];
  const width = sizeFlag === 0 ? (isSingleSegment ? 1 : 0) : 1 << sizeFlag;
  if (width === 0 || at + width > frame.length) return undefined;
  if (width === 1) return frame[at];
  if (width === 2) return view.getUint16(at, true) + 256;
  return width === 4 ? view.getUint32(at, true) : Number(view.getBigUint64(at, true));
}

function readEncoding(description) {
  const found = { ...DEFAULT_ENCODING, ...description.splat_encoding };
  const { sh4Max, ...encoding } = Object.fromEntries(Object.keys(DEFAULT_ENCODING).map((name) => [name, found[name]]));
  for (const [name, value] of Object.entries({ ...encoding, sh4Max })) {
    if (!Number.isFinite(value))
      throw new GspkError(`expected a number, found ${JSON.stringify(value)}`, { field: `splat_encoding.${name}` });
  }
  if (encoding.rgbMax <= encoding.rgbMin)
    throw new GspkError("rgbMax must be above rgbMin", { field: "splat_encoding.rgbMax" });
  if (encoding.lnScaleMax <= encoding.lnScaleMin)
    throw new GspkError("lnScaleMax must be above lnScaleMin", { field: "splat_encoding.lnScaleMax" });
  return encoding;
}

function isCount(value) {
  return Number.isSafeInteger(value) && value >= 0;
}

function checkCrc(bytes, expected, { field, offset }) {
  const found = crc32(bytes);
  if (found !== expected) {
    const hex = (value) => (Number.isInteger(value) ? `0x${value.toString(16).padStart(8, "0")}` : JSON.stringify(value));
    throw new GspkError(`the checksum is ${hex(found)}, the file says ${hex(expected)}: the bytes are damaged`, {
      field,
      offset,
    });
  }
}

let crcTable;

/** CRC-32 as in zlib (IEEE 802.3, reflected). */
function crc32(bytes) {
  crcTable ??= Uint32Array.from({ length: 256 }, (_, byte) => {
    let value = byte;
    for (let bit = 0; bit < 8; bit++) value = value & 1 ? 0xedb88320 ^ (value >>> 1) : value >>> 1;
    return value;
  });
  let crc = 0xffffffff;
  for (let i = 0; i < bytes.length; i++) crc = crcTable[(crc ^ bytes[i]) & 0xff] ^ (crc >>> 8);
  return (crc ^ 0xffffffff) >>> 0;
}
