/**
 * Evaluated splats as the words of Spark's PackedSplats (docs/formats/spark.md), in ranges fitted to the bundle.
 */
import { evaluateRest } from "./evaluate.js";

const SH_C0 = 0.28209479177387814;
const FLAT_LN_SCALE = -30;
const TEXTURE_WIDTH = 2048;
const TEXTURE_LAYER = TEXTURE_WIDTH * 2048;
// Bits a value and words a splat of each band.
export const BANDS = [
  { name: "sh1", first: 0, values: 9, bits: 7, words: 2 },
  { name: "sh2", first: 9, values: 15, bits: 8, words: 4 },
  { name: "sh3", first: 24, values: 21, bits: 6, words: 4 },
];

/** Splats that Spark's textures hold where `count` are wanted: whole rows, and whole layers once there are several. */
export function paddedCount(count) {
  const unit = count > TEXTURE_LAYER ? TEXTURE_LAYER : TEXTURE_WIDTH;
  return Math.max(1, Math.ceil(count / unit)) * unit;
}

/** Ranges that hold every value that the codebooks and palettes of a bundle can give, as Spark's `splatEncoding`. */
export function fittedEncoding(bundle) {
  const colors = bundle.sh0Codebook.map((value) => SH_C0 * value + 0.5);
  const logs = bundle.logScales.filter((value) => value >= FLAT_LN_SCALE);
  const encoding = {
    ...spread("rgbMin", "rgbMax", colors, 0, 1),
    ...spread("lnScaleMin", "lnScaleMax", logs, -12, 9),
    sh1Max: 1,
    sh2Max: 1,
    sh3Max: 1,
  };
  for (const { name, first, values } of BANDS.slice(0, bundle.degree)) {
    let largest = 0;
    for (const palette of bundle.palettes) {
      const width = 3 * palette.coefficients;
      const offset = first - 3 * palette.firstCoefficient;
      if (offset < 0 || offset >= width) continue;
      for (let at = offset; at < palette.values.length; at += width) {
        for (let k = 0; k < values; k++) largest = Math.max(largest, Math.abs(palette.values[at + k]));
      }
    }
    encoding[`${name}Max`] = largest || 1;
  }
  return encoding;
}

function spread(lowName, highName, values, low, high) {
  const found = [values.reduce((a, b) => Math.min(a, b), Infinity), values.reduce((a, b) => Math.max(a, b), -Infinity)];
  return found[0] < found[1] ? { [lowName]: found[0], [highName]: found[1] } : { [lowName]: low, [highName]: high };
}

/** Packs the splats of one bundle; what the palettes give is encoded once. */
export class Packer {
  constructor(bundle) {
    this.bundle = bundle;
    this.encoding = fittedEncoding(bundle);
    this.entryWords = bundle.palettes.map((palette) => this.packPalette(palette));
  }

  /** Words of every entry of a palette, by band: a splat whose label does not change copies them. */
  packPalette(palette) {
    const bands = this.bandsOf(palette);
    return bands.map((band) => {
      const words = new Uint32Array(palette.count * band.words);
      const width = 3 * palette.coefficients;
      const offset = band.first - 3 * palette.firstCoefficient;
      for (let entry = 0; entry < palette.count; entry++) {
        encodeBand(palette.values, entry * width + offset, band, this.encoding[`${band.name}Max`], words, entry * band.words);
      }
      return words;
    });
  }

  bandsOf({ firstCoefficient, coefficients }) {
    const [low, high] = [3 * firstCoefficient, 3 * (firstCoefficient + coefficients)];
    return BANDS.filter(({ first }) => first >= low && first < high);
  }

  /**
   * Words for one displayed time.
   *
   * @param {object} state what `evaluate` returned
   * @returns {{packedArray: Uint32Array, extra: Object<string, Uint32Array>}} padded to whole texture rows
   */
  pack(state, a, b, fraction) {
    const { count } = a;
    const padded = paddedCount(count);
    const packedArray = new Uint32Array(4 * padded);
    packSplats(state, count, this.encoding, packedArray);
    const extra = {};
    let rest = null;
    this.bundle.palettes.forEach((palette, p) => {
      const [from, to] = [a.labels[p], b.labels[p]];
      this.bandsOf(palette).forEach((band, k) => {
        const source = this.entryWords[p][k];
        const words = new Uint32Array(band.words * padded);
        for (let i = 0; i < count; i++) {
          if (fraction === 0 || from[i] === to[i]) {
            for (let w = 0; w < band.words; w++) words[band.words * i + w] = source[band.words * from[i] + w];
          } else {
            rest ??= evaluateRest(this.bundle.palettes, this.bundle.restCoefficients, a, b, fraction);
            const at = 3 * this.bundle.restCoefficients * i + band.first;
            encodeBand(rest, at, band, this.encoding[`${band.name}Max`], words, band.words * i);
          }
        }
        extra[band.name] = words;
      });
    });
    return { packedArray, extra };
  }
}

/** Four words a splat. */
export function packSplats({ means, logScales, quats, opacities, sh0 }, count, encoding, words) {
  const { rgbMin, rgbMax, lnScaleMin, lnScaleMax } = encoding;
  const toByte = (value) => Math.min(255, Math.max(0, Math.round(value)));
  const color = (value) => toByte(((SH_C0 * value + 0.5 - rgbMin) / (rgbMax - rgbMin)) * 255);
  const steps = 254 / (lnScaleMax - lnScaleMin);
  const scale = (log) =>
    log < FLAT_LN_SCALE ? 0 : Math.min(255, Math.max(1, Math.round((log - lnScaleMin) * steps) + 1));
  for (let i = 0, k = 0, q = 0; i < count; i++, k += 3, q += 4) {
    const rotation = packRotation(quats[q], quats[q + 1], quats[q + 2], quats[q + 3]);
    words[q] =
      color(sh0[k]) | (color(sh0[k + 1]) << 8) | (color(sh0[k + 2]) << 16) | (Math.round(opacities[i] * 255) << 24);
    words[q + 1] = toHalf(means[k]) | (toHalf(means[k + 1]) << 16);
    words[q + 2] = toHalf(means[k + 2]) | ((rotation & 0xffff) << 16);
    words[q + 3] =
      scale(logScales[k]) | (scale(logScales[k + 1]) << 8) | (scale(logScales[k + 2]) << 16) | ((rotation >> 16) << 24);
  }
}

/** Octahedral axis, two bytes, and angle, the third. */
function packRotation(w, x, y, z) {
  if (w < 0) {
    w = -w;
    x = -x;
    y = -y;
    z = -z;
  }
  const angle = Math.round((2 * Math.acos(Math.min(w, 1)) * 255) / Math.PI);
  if (Math.sqrt(x * x + y * y + z * z) < 1e-6) {
    x = 1;
    y = z = 0;
  }
  const sum = Math.abs(x) + Math.abs(y) + Math.abs(z);
  let px = x / sum;
  let py = y / sum;
  if (z < 0) {
    const folded = (1 - Math.abs(py)) * (px < 0 ? -1 : 1);
    py = (1 - Math.abs(px)) * (py < 0 ? -1 : 1);
    px = folded;
  }
  return Math.round((px / 2 + 0.5) * 255) | (Math.round((py / 2 + 0.5) * 255) << 8) | (angle << 16);
}

/** Values of a band from `at` on, as signed codes one after another in a string of words. */
function encodeBand(source, at, { values, bits }, limit, words, target) {
  const largest = 2 ** (bits - 1) - 1;
  const mask = 2 ** bits - 1;
  for (let k = 0; k < values; k++) {
    const code = Math.min(largest, Math.max(-largest, Math.round((source[at + k] * largest) / limit))) & mask;
    const place = k * bits;
    const [word, shift] = [target + (place >> 5), place & 31];
    words[word] |= code << shift;
    if (shift + bits > 32) words[word + 1] |= code >>> (32 - shift);
  }
}

const float = new Float32Array(1);
const float32Bits = new Uint32Array(float.buffer);

/** Bits of the nearest half, ties to even. */
export function toHalf(value) {
  float[0] = value;
  const bits = float32Bits[0];
  const sign = (bits >>> 16) & 0x8000;
  const magnitude = bits & 0x7fffffff;
  if (magnitude >= 0x47800000) return sign | (magnitude > 0x7f800000 ? 0x7e00 : 0x7c00);
  if (magnitude < 0x38800000) {
    const scaled = Math.abs(value) * 2 ** 24; // subnormal halves are multiples of 2^-24
    const below = Math.floor(scaled);
    const rest = scaled - below;
    return sign | (below + (rest > 0.5 || (rest === 0.5 && below & 1) ? 1 : 0));
  }
  const rounded = magnitude + 0xfff + ((magnitude >> 13) & 1);
  return sign | Math.min(0x7c00, (rounded - 0x38000000) >> 13);
}
