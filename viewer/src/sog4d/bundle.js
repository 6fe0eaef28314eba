/**
 * Reads .sog4d bundles (docs/formats/sog4d.md): the ZIP by zip.js, the lossless WebP images by libwebp as WebAssembly,
 * so that every byte comes out as it was stored, without a canvas that would premultiply or convert colors.
 */
import { BlobReader, Uint8ArrayWriter, ZipReader, configure } from "@zip.js/zip.js/lib/zip-core-native.js";

configure({ useWebWorkers: false }); // this is a worker already

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
   */
  static async open(blob, decodeWebp) {
    let entries;
    try {
      entries = await new ZipReader(new BlobReader(blob)).getEntries();
    } catch (cause) {
      throw new Sog4dError(`this is no ZIP archive: ${cause.message}`);
    }
    // Of entries with the same name the last one counts.
    const byName = new Map(entries.map((entry) => [entry.filename, entry]));
    const bundle = new Bundle(byName, decodeWebp);
    const text = new TextDecoder("utf-8", { fatal: true }).decode(await bundle.bytes("meta.json"));
    bundle.readMeta(JSON.parse(text));
    await bundle.readPalettes();
    return bundle;
  }

  constructor(entries, decodeWebp) {
    this.entries = entries;
    this.decodeWebp = decodeWebp;
    this.deltas = new Map();
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
    return entry.getData(new Uint8ArrayWriter(), { checkSignature: true });
  }

  /** RGBA bytes of an image, as stored. */
  async pixels(path) {
    const bytes = await this.bytes(path);
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

  /**
   * Stored values of a keyframe: means, logScales, quats (wxyz, unit, w >= 0), opacities, sh0, and labels of each palette.
   */
  async keyframe(frame) {
    const images = {};
    for (const [name, template] of Object.entries(this.paths)) images[name] = await this.pixels(framePath(template, frame));
    const { splatCount: count, logScales: codebook, sh0Codebook } = this;
    const means = new Float32Array(3 * count);
    const logScales = new Float32Array(3 * count);
    const sh0 = new Float32Array(3 * count);
    const opacities = new Float32Array(count);
    const low = this.rangeMin[frame];
    const steps = this.rangeMax[frame].map((high, axis) => (high - low[axis]) / 65535);
    for (let i = 0; i < count; i++) {
      const index = images.scale[4 * i] | (images.scale[4 * i + 1] << 8);
      if (3 * index >= codebook.length) {
        throw new Sog4dError(`scale index ${index} of splat ${i} is not in the codebook`, framePath(this.paths.scale, frame));
      }
      for (let axis = 0; axis < 3; axis++) {
        const at = 4 * i + axis;
        means[3 * i + axis] = low[axis] + (images.lo[at] | (images.hi[at] << 8)) * steps[axis];
        logScales[3 * i + axis] = codebook[3 * index + axis];
        sh0[3 * i + axis] = sh0Codebook[images.sh0[at]];
      }
      opacities[i] = images.sh0[4 * i + 3] / 255;
    }
    const labels = [];
    for (const palette of this.palettes) labels.push(await this.labels(palette, frame));
    return { frame, count, means, logScales, quats: decodeQuaternions(images.rotation, count), opacities, sh0, labels };
  }

  /** Labels of a palette in a frame. */
  async labels(palette, frame) {
    if (!palette.segments) return this.labelImage(palette, framePath(palette.labelsPath, frame));
    const segment = palette.segments.find(({ startFrame, frameCount }) => frame < startFrame + frameCount);
    if (!segment) throw new Sog4dError(`no segment covers frame ${frame}`, palette.name);
    const labels = await this.labelImage(palette, segment.baseLabelsPath);
    const blocks = await this.delta(segment, palette);
    for (const { splats, values } of blocks.slice(0, frame - segment.startFrame)) {
      for (let k = 0; k < splats.length; k++) labels[splats[k]] = values[k];
    }
    return labels;
  }

  /** Labels that are stored whole. */
  async labelImage(palette, path) {
    const pixels = await this.pixels(path);
    const labels = new Uint16Array(this.splatCount);
    for (let i = 0; i < labels.length; i++) {
      labels[i] = pixels[4 * i] | (pixels[4 * i + 1] << 8);
      if (labels[i] >= palette.count) throw new Sog4dError(`label ${labels[i]} of splat ${i} is not in the palette`, path);
    }
    return labels;
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
