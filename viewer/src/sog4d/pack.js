/**
 * Evaluated splats as the words of Spark's PackedSplats (docs/formats/spark.md), in ranges fitted to the bundle.
 */
import { mix } from "./evaluate.js";

const SH_C0 = 0.28209479177387814;
const FLAT_LN_SCALE = -30;
const TEXTURE_WIDTH = 2048;
const TEXTURE_LAYER = TEXTURE_WIDTH * 2048;
const BETWEEN = -1; // shown between two entries of a palette
const NOTHING = -2;
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

/** Packs the splats of one bundle; what the palettes give is encoded once, and written where it changes. */
export class Packer {
  constructor(bundle) {
    this.bundle = bundle;
    this.encoding = fittedEncoding(bundle);
    this.entryWords = bundle.palettes.map((palette) => this.packPalette(palette));
    const padded = paddedCount(bundle.splatCount);
    this.packedArray = new Uint32Array(4 * padded);
    this.extra = Object.fromEntries(
      BANDS.slice(0, bundle.degree).map(({ name, words }) => [name, new Uint32Array(words * padded)]),
    );
    // What the words of each splat stand for: an entry of the palette, BETWEEN or NOTHING.
    this.shown = bundle.palettes.map(() => new Int32Array(bundle.splatCount).fill(NOTHING));
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
   * @returns {{packedArray: Uint32Array, extra: Object<string, Uint32Array>}} padded to whole texture rows, and written
   *   again by the next call; of the bands those that changed
   */
  pack(state, a, b, fraction) {
    packSplats(state, a.count, this.encoding, this.packedArray);
    const extra = {};
    this.bundle.palettes.forEach((palette, p) => {
      if (!this.packLabels(p, a.labels[p], fraction === 0 ? a.labels[p] : b.labels[p], fraction)) return;
      for (const { name } of this.bandsOf(palette)) extra[name] = this.extra[name];
    });
    return { packedArray: this.packedArray, extra };
  }

  /** Write the words of the splats whose labels are not those that are shown; whether there were any. */
  packLabels(p, from, to, fraction) {
    const palette = this.bundle.palettes[p];
    const shown = this.shown[p];
    const width = 3 * palette.coefficients;
    const bands = this.bandsOf(palette).map((band, k) => ({
      ...band,
      source: this.entryWords[p][k],
      target: this.extra[band.name],
      limit: this.encoding[`${band.name}Max`],
      offset: band.first - 3 * palette.firstCoefficient,
    }));
    const mixed = new Float32Array(width);
    let hasChanged = false;
    for (let i = 0; i < shown.length; i++) {
      const label = from[i] === to[i] ? from[i] : BETWEEN;
      if (label === shown[i] && label !== BETWEEN) continue;
      hasChanged = true;
      shown[i] = label;
      if (label === BETWEEN) {
        const [first, second] = [width * from[i], width * to[i]];
        for (let k = 0; k < width; k++) mixed[k] = mix(palette.values[first + k], palette.values[second + k], fraction);
      }
      for (const band of bands) {
        const { source, target, words } = band;
        const at = words * i;
        if (label === BETWEEN) {
          target.fill(0, at, at + words);
          encodeBand(mixed, band.offset, band, band.limit, target, at);
        } else {
          for (let w = 0; w < words; w++) target[at + w] = source[words * label + w];
        }
      }
    }
    return hasChanged;
  }
}

/** Four words a splat. */
export function packSplats({ means, logScales, quats, opacities, sh0 }, count, encoding, words) {
  const { rgbMin, rgbMax, lnScaleMin, lnScaleMax } = encoding;
  const bits = new Uint32Array(means.buffer, means.byteOffset, means.length);
  const colorStep = (SH_C0 * 255) / (rgbMax - rgbMin);
  const colorStart = ((0.5 - rgbMin) * 255) / (rgbMax - rgbMin) + 0.5; // half a step, so that cutting off rounds
  const color = (value) => {
    const code = colorStep * value + colorStart;
    return code < 0 ? 0 : code > 255 ? 255 : code | 0;
  };
  const steps = 254 / (lnScaleMax - lnScaleMin);
  const scale = (log) => {
    if (log < FLAT_LN_SCALE) return 0;
    const code = (log - lnScaleMin) * steps + 1.5;
    return code < 1 ? 1 : code > 255 ? 255 : code | 0;
  };
  for (let i = 0, k = 0, q = 0; i < count; i++, k += 3, q += 4) {
    const rotation = packRotation(quats[q], quats[q + 1], quats[q + 2], quats[q + 3]);
    words[q] =
      color(sh0[k]) | (color(sh0[k + 1]) << 8) | (color(sh0[k + 2]) << 16) | ((opacities[i] * 255 + 0.5) << 24);
    words[q + 1] = halfOf(bits[k]) | (halfOf(bits[k + 1]) << 16);
    words[q + 2] = halfOf(bits[k + 2]) | ((rotation & 0xffff) << 16);
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
  const angle = ((2 * Math.acos(w < 1 ? w : 1) * 255) / Math.PI + 0.5) | 0;
  if (x * x + y * y + z * z < 1e-12) {
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
  return (((px / 2 + 0.5) * 255 + 0.5) | 0) | ((((py / 2 + 0.5) * 255 + 0.5) | 0) << 8) | (angle << 16);
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

/** Bits of the half that is nearest to a float32 given by its bits, ties to even. */
export function halfOf(bits) {
  const sign = (bits >>> 16) & 0x8000;
  const magnitude = bits & 0x7fffffff;
  if (magnitude >= 0x47800000) return sign | (magnitude > 0x7f800000 ? 0x7e00 : 0x7c00);
  if (magnitude >= 0x38800000) return sign | ((magnitude + 0xfff + ((magnitude >> 13) & 1) - 0x38000000) >> 13);
  if (magnitude <= 0x33000000) return sign; // up to half of the smallest subnormal half, 2^-24
  const shift = 126 - (magnitude >> 23);
  const significand = (magnitude & 0x7fffff) | 0x800000;
  const below = significand >> shift;
  const rest = significand & ((1 << shift) - 1);
  const middle = 1 << (shift - 1);
  return sign | (below + (rest > middle || (rest === middle && below & 1) ? 1 : 0));
}
