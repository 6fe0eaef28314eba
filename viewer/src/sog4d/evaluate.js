/**
 * A sequence at a time, by the rules of docs/formats/sog4d.md: positions, colors, SH and opacities linear, scales in the
 * log domain from 1e-8 up, rotations by normalized interpolation on one hemisphere, opacities below 1/255 gone.
 */
const LOG_FLOOR = Math.log(1e-8);
const MIN_LENGTH = 1e-8;
const VISIBLE = (1 / 255) * (1 - 1e-6); // a stored byte of 1 passes

/**
 * What is drawn between two keyframes (`Bundle.keyframe`); `fraction` 0 gives the first as stored.
 *
 * @returns {{means: Float32Array, logScales: Float32Array, quats: Float32Array, opacities: Float32Array, sh0: Float32Array}}
 */
export function evaluate(a, b, fraction) {
  const opacities = new Float32Array(a.count);
  if (fraction === 0 || a.frame === b.frame) {
    for (let i = 0; i < a.count; i++) opacities[i] = a.opacities[i] < VISIBLE ? 0 : a.opacities[i];
    return { means: a.means, logScales: a.logScales, quats: a.quats, opacities, sh0: a.sh0 };
  }
  for (let i = 0; i < a.count; i++) {
    const opacity = mix(a.opacities[i], b.opacities[i], fraction);
    opacities[i] = opacity < VISIBLE ? 0 : opacity;
  }
  const logScales = new Float32Array(3 * a.count);
  for (let k = 0; k < logScales.length; k++) {
    logScales[k] = mix(Math.max(a.logScales[k], LOG_FLOOR), Math.max(b.logScales[k], LOG_FLOOR), fraction);
  }
  return {
    means: mixed(a.means, b.means, fraction),
    logScales,
    quats: mixedRotations(a.quats, b.quats, fraction),
    opacities,
    sh0: mixed(a.sh0, b.sh0, fraction),
  };
}

/**
 * SH above the constant term between two keyframes, (splat, coefficient, rgb).
 *
 * @param {Array} palettes `Bundle.palettes`
 * @param {number} coefficients of all bands
 */
export function evaluateRest(palettes, coefficients, a, b, fraction) {
  const rest = new Float32Array(3 * coefficients * a.count);
  palettes.forEach(({ values, coefficients: own, firstCoefficient }, p) => {
    const width = 3 * own;
    for (let i = 0; i < a.count; i++) {
      const first = width * a.labels[p][i];
      const second = width * b.labels[p][i];
      const at = 3 * (coefficients * i + firstCoefficient);
      for (let k = 0; k < width; k++) {
        rest[at + k] = mix(values[first + k], values[second + k], fraction);
      }
    }
  });
  return rest;
}

function mix(a, b, fraction) {
  return a + (b - a) * fraction; // keeps equal values as they are
}

function mixed(a, b, fraction) {
  const result = new Float32Array(a.length);
  for (let k = 0; k < a.length; k++) result[k] = mix(a[k], b[k], fraction);
  return result;
}

function mixedRotations(a, b, fraction) {
  const result = new Float32Array(a.length);
  for (let i = 0; i < a.length; i += 4) {
    const dot = a[i] * b[i] + a[i + 1] * b[i + 1] + a[i + 2] * b[i + 2] + a[i + 3] * b[i + 3];
    const sign = dot < 0 ? -1 : 1;
    const w = mix(a[i], sign * b[i], fraction);
    const x = mix(a[i + 1], sign * b[i + 1], fraction);
    const y = mix(a[i + 2], sign * b[i + 2], fraction);
    const z = mix(a[i + 3], sign * b[i + 3], fraction);
    const length = Math.sqrt(w * w + x * x + y * y + z * z);
    const isNull = length < MIN_LENGTH;
    result[i] = isNull ? 1 : w / length;
    result[i + 1] = isNull ? 0 : x / length;
    result[i + 2] = isNull ? 0 : y / length;
    result[i + 3] = isNull ? 0 : z / length;
  }
  return result;
}
