/**
 * Reads .sog4d bundles (docs/formats/sog4d.md): the ZIP by zip.js, the lossless WebP images by libwebp as WebAssembly,
 * so that every byte comes out as it was stored, without a canvas that would premultiply or convert colors.
 */
import { BlobReader, Uint8ArrayWriter, ZipReader, configure } from "@zip.js/zip.js/lib/zip-core-native.js";

configure({ useWebWorkers: false }); // this is a worker already

const [LOCAL_HEADER_BYTES, LOCAL_HEADER_MAGIC] = [30, 0x04034b50];
const DELTA_MAGIC = "SOG4DLB1";
const DELTA_HEADER_BYTES = 28;
const UPDATE_BYTES = 8;
const REST = [0, 3, 8, 15];
const BANDS = ["sh1", "sh2", "sh3"];

/** Something in the bundle is wrong; `path` is the entry or field. */
export class Sog4dError extends Error {
  constructor(message, path) {
    super(path ? `${path}: ${message}` : message);
    this.name = "Sog4dError";
    this.path = path;
  }
}

/** A bundle whose frames are decoded when they are asked for. */
export class Bundle {
  /**
   * Open a bundle.
   *
   * @param {Blob} blob the file
   * @param {(bytes: ArrayBuffer) => Promise<{width: number, height: number, data: Uint8ClampedArray}>} decodeWebp
   * @param {object} [options]
   * @param {boolean} [options.hasPalettes] whether the values of the SH palettes are read
   */
  static async open(blob, decodeWebp, { hasPalettes = true } = {}) {
    let entries;
    try {
      entries = await new ZipReader(new BlobReader(blob)).getEntries();
    } catch (cause) {
      throw new Sog4dError(`this is no ZIP archive: ${cause.message}`);
    }
    // Of entries with the same name the last one counts.
    const byName = new Map(entries.map((entry) => [entry.filename, entry]));
    const bundle = new Bundle(blob, byName, decodeWebp);
    const text = new TextDecoder("utf-8", { fatal: true }).decode(await bundle.bytes("meta.json"));
    bundle.readMeta(JSON.parse(text));
    if (hasPalettes) await bundle.readPalettes();
    return bundle;
  }

  constructor(blob, entries, decodeWebp) {
    this.blob = blob;
    this.entries = entries;
    this.decodeWebp = decodeWebp;
    this.deltas = new Map();
    this.last = new Map(); // stream -> {bytes, value}: what does not change from frame to frame is decoded once
    this.shown = new Map(); // palette -> {segment, frame, labels}: later frames of a segment go on from there
  }

  /** Take over what meta.json says, with numbers as the float32 that every reader makes of them. */
  readMeta(meta) {
    if (meta.format !== "sog4d") throw new Sog4dError(`expected "sog4d", found ${JSON.stringify(meta.format)}`, "format");
    if (![1, 2].includes(meta.version)) throw new Sog4dError(`expected 1 or 2, found ${meta.version}`, "version");
    const { position, scale, rotation, sh } = meta.streams;
    this.version = meta.version;
    this.splatCount = meta.splatCount;
    this.frameCount = meta.frameCount;
    this.times = meta.timeMapping.type === "explicit" ? meta.timeMapping.frameTimesNormalized : null;
    this.width = meta.layout.width;
    this.height = meta.layout.height;
    this.rangeMin = position.rangeMin.map(vector);
    this.rangeMax = position.rangeMax.map(vector);
    this.logScales = Float32Array.from(scale.codebook.flatMap(vector), (value) => Math.log(value));
    this.sh0Codebook = Float32Array.from(sh.sh0Codebook);
    this.degree = sh.bands;
    this.paths = {
      hi: position.hiPath,
      lo: position.loPath,
      scale: scale.indicesPath,
      rotation: rotation.path,
      sh0: sh.sh0Path,
    };
    this.palettes = describePalettes(meta.version, sh);
    this.restCoefficients = REST[sh.bands];
  }

  /** Decode the SH palettes: values as (entry, coefficient, rgb). */
  async readPalettes() {
    for (const palette of this.palettes) {
      const bytes = await this.bytes(palette.path);
      const scalars = palette.count * palette.coefficients * 3;
      const width = palette.type === "f16" ? 2 : 4;
      if (bytes.length !== scalars * width) {
        throw new Sog4dError(`expected ${scalars * width} bytes, found ${bytes.length}`, palette.path);
      }
      const aligned = bytes.slice().buffer;
      palette.values = palette.type === "f16" ? fromHalves(new Uint16Array(aligned)) : new Float32Array(aligned);
    }
  }

  /** Bytes of an entry. */
  async bytes(path) {
    const entry = this.entries.get(path);
    if (!entry) throw new Sog4dError("the archive has no such file", path);
    const isStored = entry.compressionMethod === 0 && !entry.encrypted && entry.compressedSize === entry.uncompressedSize;
    const header = new DataView(await this.blob.slice(entry.offset, entry.offset + LOCAL_HEADER_BYTES).arrayBuffer());
    const isHere = header.byteLength === LOCAL_HEADER_BYTES && header.getUint32(0, true) === LOCAL_HEADER_MAGIC;
    if (!isStored || !isHere) return entry.getData(new Uint8ArrayWriter(), { checkSignature: true });
    // As they lie in the file, without the streams of the library, which take longer than decoding an image.
    const start = entry.offset + LOCAL_HEADER_BYTES + header.getUint16(26, true) + header.getUint16(28, true);
    const bytes = new Uint8Array(await this.blob.slice(start, start + entry.uncompressedSize).arrayBuffer());
    if (bytes.length !== entry.uncompressedSize || crc32(bytes) !== entry.signature >>> 0) {
      throw new Sog4dError("the bytes do not have the checksum of the directory", path);
    }
    return bytes;
  }

  /** RGBA bytes of an image, as stored. */
  async pixels(path) {
    return this.decode(await this.bytes(path), path);
  }

  async decode(bytes, path) {
    let image;
    try {
      image = await this.decodeWebp(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength));
    } catch (cause) {
      throw new Sog4dError(`the image does not decode: ${cause.message}`, path);
    }
    if (image.width !== this.width || image.height !== this.height) {
      throw new Sog4dError(`expected ${this.width}x${this.height} px, found ${image.width}x${image.height}`, path);
    }
    return image.data;
  }

  /** What `make` makes of an image; the same bytes as the last of the stream give the same value again. */
  async stream(name, path, make) {
    const bytes = await this.bytes(path);
    const last = this.last.get(name);
    if (last && areEqual(last.bytes, bytes)) return last.value;
    const value = make(await this.decode(bytes, path));
    this.last.set(name, { bytes, value });
    return value;
  }

  /**
   * Stored values of a keyframe: means, logScales, quats (wxyz, unit, w >= 0), opacities, sh0, and labels of each palette.
   * Arrays other than means may be those of an earlier keyframe.
   */
  async keyframe(frame) {
    const stream = (name, make) => {
      const path = framePath(this.paths[name], frame);
      return this.stream(name, path, (pixels) => make(pixels, path));
    };
    const [high, low, logScales, quats, { sh0, opacities }, ...labels] = await Promise.all([
      stream("hi", (pixels) => pixels),
      stream("lo", (pixels) => pixels),
      stream("scale", (pixels, path) => this.decodeScales(pixels, path)),
      stream("rotation", (pixels) => decodeQuaternions(pixels, this.splatCount)),
      stream("sh0", (pixels) => this.decodeColors(pixels)),
      ...this.palettes.map((palette) => this.labels(palette, frame)),
    ]);
    return { frame, count: this.splatCount, means: this.decodeMeans(high, low, frame), logScales, quats, opacities, sh0, labels };
  }

  decodeMeans(high, low, frame) {
    const [x0, y0, z0] = this.rangeMin[frame];
    const [x1, y1, z1] = this.rangeMax[frame];
    const [dx, dy, dz] = [(x1 - x0) / 65535, (y1 - y0) / 65535, (z1 - z0) / 65535];
    const means = new Float32Array(3 * this.splatCount);
    for (let k = 0, at = 0; k < means.length; k += 3, at += 4) {
      means[k] = x0 + (low[at] | (high[at] << 8)) * dx;
      means[k + 1] = y0 + (low[at + 1] | (high[at + 1] << 8)) * dy;
      means[k + 2] = z0 + (low[at + 2] | (high[at + 2] << 8)) * dz;
    }
    return means;
  }

  decodeScales(pixels, path) {
    const codebook = this.logScales;
    const logScales = new Float32Array(3 * this.splatCount);
    for (let k = 0, at = 0; k < logScales.length; k += 3, at += 4) {
      const entry = 3 * (pixels[at] | (pixels[at + 1] << 8));
      if (entry >= codebook.length) {
        throw new Sog4dError(`scale index ${entry / 3} of splat ${k / 3} is not in the codebook`, path);
      }
      logScales[k] = codebook[entry];
      logScales[k + 1] = codebook[entry + 1];
      logScales[k + 2] = codebook[entry + 2];
    }
    return logScales;
  }

  decodeColors(pixels) {
    const codebook = this.sh0Codebook;
    const sh0 = new Float32Array(3 * this.splatCount);
    const opacities = new Float32Array(this.splatCount);
    for (let i = 0, k = 0, at = 0; i < opacities.length; i++, k += 3, at += 4) {
      sh0[k] = codebook[pixels[at]];
      sh0[k + 1] = codebook[pixels[at + 1]];
      sh0[k + 2] = codebook[pixels[at + 2]];
      opacities[i] = pixels[at + 3] / 255;
    }
    return { sh0, opacities };
  }

  /** Labels of a palette in a frame. */
  async labels(palette, frame) {
    if (!palette.segments) return this.labelImage(palette, framePath(palette.labelsPath, frame));
    const segment = palette.segments.find(({ startFrame, frameCount }) => frame < startFrame + frameCount);
    if (!segment) throw new Sog4dError(`no segment covers frame ${frame}`, palette.name);
    const blocks = await this.delta(segment, palette);
    let state = this.shown.get(palette);
    if (state?.segment !== segment || state.frame > frame) {
      const base = await this.labelImage(palette, segment.baseLabelsPath);
      state = { segment, frame: segment.startFrame, labels: base.slice() };
    }
    // Nothing is waited for from here on, so that frames that are decoded at the same time do not mix.
    for (const { splats, values } of blocks.slice(state.frame - segment.startFrame, frame - segment.startFrame)) {
      for (let k = 0; k < splats.length; k++) state.labels[splats[k]] = values[k];
    }
    state.frame = frame;
    this.shown.set(palette, state);
    return state.labels.slice();
  }

  /** Labels that are stored whole. */
  labelImage(palette, path) {
    return this.stream(palette.name, path, (pixels) => {
      const labels = new Uint16Array(this.splatCount);
      for (let i = 0, at = 0; i < labels.length; i++, at += 4) {
        labels[i] = pixels[at] | (pixels[at + 1] << 8);
        if (labels[i] >= palette.count) throw new Sog4dError(`label ${labels[i]} of splat ${i} is not in the palette`, path);
      }
      return labels;
    });
  }

  /** Changes of a segment, a block a later frame; read once. */
  async delta(segment, palette) {
    const path = segment.deltaPath;
    if (!this.deltas.has(path)) this.deltas.set(path, readDelta(await this.bytes(path), segment, palette, this.splatCount));
    return this.deltas.get(path);
  }

  /** [first, second, fraction]: the keyframes around a normalized time. */
  bracket(t) {
    const last = this.frameCount - 1;
    if (last === 0) return [0, 0, 0];
    if (!this.times) {
      const u = Math.min(Math.max(t, 0), 1) * last;
      const first = Math.min(Math.floor(u), last);
      return [first, Math.min(first + 1, last), u - first];
    }
    if (t <= this.times[0]) return [0, 1, 0];
    if (t >= this.times[last]) return [last, last, 0];
    const second = this.times.findIndex((time) => time > t);
    const span = this.times[second] - this.times[second - 1];
    return [second - 1, second, span > 0 ? (t - this.times[second - 1]) / span : 0];
  }
}

function describePalettes(version, sh) {
  if (sh.bands === 0) return [];
  if (version === 1) {
    return [
      {
        name: "shN",
        firstCoefficient: 0,
        coefficients: REST[sh.bands],
        count: sh.shNCount,
        type: sh.shNCentroidsType,
        path: sh.shNCentroidsPath,
        labelsPath: sh.shNLabelsPath,
        segments: sh.shNLabelsEncoding === "delta-v1" ? sh.shNDeltaSegments : null,
      },
    ];
  }
  return BANDS.slice(0, sh.bands).map((name, band) => ({
    name,
    firstCoefficient: REST[band],
    coefficients: REST[band + 1] - REST[band],
    count: sh[name].count,
    type: sh[name].centroidsType,
    path: sh[name].centroidsPath,
    labelsPath: sh[name].labelsPath,
    segments: sh[name].labelsEncoding === "delta-v1" ? sh[name].deltaSegments : null,
  }));
}

function readDelta(bytes, segment, palette, splatCount) {
  const path = segment.deltaPath;
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const magic = String.fromCharCode(...bytes.subarray(0, 8));
  if (magic !== DELTA_MAGIC || bytes.length < DELTA_HEADER_BYTES) throw new Sog4dError("this is no label delta", path);
  const header = [1, 2, 3, 4, 5].map((word) => view.getUint32(4 + 4 * word, true));
  const expected = [1, segment.startFrame, segment.frameCount, splatCount, palette.count];
  if (header.join() !== expected.join()) throw new Sog4dError(`expected a header of ${expected}, found ${header}`, path);
  const blocks = [];
  let at = DELTA_HEADER_BYTES;
  for (let frame = 1; frame < segment.frameCount; frame++) {
    const count = at + 4 <= bytes.length ? view.getUint32(at, true) : NaN;
    if (!(at + 4 + count * UPDATE_BYTES <= bytes.length)) throw new Sog4dError(`the delta ends in block ${frame}`, path);
    const splats = new Uint32Array(count);
    const values = new Uint16Array(count);
    for (let k = 0; k < count; k++) {
      splats[k] = view.getUint32(at + 4 + UPDATE_BYTES * k, true);
      values[k] = view.getUint16(at + 8 + UPDATE_BYTES * k, true);
      if (splats[k] >= splatCount || values[k] >= palette.count) {
        throw new Sog4dError(`block ${frame} sets splat ${splats[k]} to label ${values[k]}`, path);
      }
    }
    blocks.push({ splats, values });
    at += 4 + count * UPDATE_BYTES;
  }
  return blocks;
}

let crcTables;

/** CRC-32 as ZIP has it, four bytes at a time. */
function crc32(bytes) {
  crcTables ??= makeCrcTables();
  const [t0, t1, t2, t3] = crcTables;
  let crc = -1;
  let i = 0;
  for (const end = bytes.length - 3; i < end; i += 4) {
    crc ^= bytes[i] | (bytes[i + 1] << 8) | (bytes[i + 2] << 16) | (bytes[i + 3] << 24);
    crc = t3[crc & 255] ^ t2[(crc >>> 8) & 255] ^ t1[(crc >>> 16) & 255] ^ t0[crc >>> 24];
  }
  for (; i < bytes.length; i++) crc = t0[(crc ^ bytes[i]) & 255] ^ (crc >>> 8);
  return ~crc >>> 0;
}

function makeCrcTables() {
  const first = Int32Array.from({ length: 256 }, (_, byte) => {
    let crc = byte;
    for (let bit = 0; bit < 8; bit++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
    return crc;
  });
  const tables = [first];
  for (let k = 1; k < 4; k++) tables.push(tables[k - 1].map((crc) => (crc >>> 8) ^ first[crc & 255]));
  return tables;
}

function areEqual(a, b) {
  if (a.length !== b.length) return false;
  for (let i = 0; i < a.length; i++) if (a[i] !== b[i]) return false;
  return true;
}

/** Bytes w x y z to unit quaternions with w >= 0; four times 128 has no direction and is the identity. */
function decodeQuaternions(pixels, count) {
  const quats = new Float32Array(4 * count);
  for (let i = 0; i < 4 * count; i += 4) {
    const w = (pixels[i] - 128) / 128;
    const x = (pixels[i + 1] - 128) / 128;
    const y = (pixels[i + 2] - 128) / 128;
    const z = (pixels[i + 3] - 128) / 128;
    const length = Math.sqrt(w * w + x * x + y * y + z * z);
    const factor = length > 0 ? (w < 0 ? -1 : 1) / length : 0;
    quats[i] = length > 0 ? w * factor : 1;
    quats[i + 1] = x * factor;
    quats[i + 2] = y * factor;
    quats[i + 3] = z * factor;
  }
  return quats;
}

/** Half-precision bits as float32. */
export function fromHalves(bits) {
  const table = (fromHalves.table ??= Float32Array.from({ length: 65536 }, (_, half) => {
    const sign = half & 0x8000 ? -1 : 1;
    const exponent = (half >> 10) & 31;
    const fraction = half & 1023;
    if (exponent === 31) return fraction ? NaN : sign * Infinity;
    return exponent ? sign * 2 ** (exponent - 25) * (1024 + fraction) : sign * 2 ** -24 * fraction;
  }));
  return Float32Array.from(bits, (half) => table[half]);
}

function framePath(template, frame) {
  return template.replaceAll("{frame}", String(frame).padStart(5, "0"));
}

function vector({ x, y, z }) {
  return [x, y, z].map(Math.fround);
}
