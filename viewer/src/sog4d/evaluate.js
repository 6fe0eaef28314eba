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
 * @param {object} [room] arrays of an earlier call, to be written again: nothing is allocated while a sequence plays
 * @returns {{means: Float32Array, logScales: Float32Array, quats: Float32Array, opacities: Float32Array, sh0: Float32Array}}
 */
export function evaluate(a, b, fraction, room = {}) {
  const take = (name, length) => (room[name] = room[name]?.length === length ? room[name] : new Float32Array(length));
  const opacities = take("opacities", a.count);
  if (fraction === 0 || a.frame === b.frame) {
    for (let i = 0; i < a.count; i++) opacities[i] = a.opacities[i] < VISIBLE ? 0 : a.opacities[i];
    return { means: a.means, logScales: a.logScales, quats: a.quats, opacities, sh0: a.sh0 };
  }
  const [from, to] = [a.opacities, b.opacities];
  for (let i = 0; i < opacities.length; i++) {
    const opacity = mix(from[i], to[i], fraction);
    opacities[i] = opacity < VISIBLE ? 0 : opacity;
  }
  return {
    means: mixInto(take("means", 3 * a.count), a.means, b.means, fraction, -Infinity),
    logScales: mixInto(take("logScales", 3 * a.count), a.logScales, b.logScales, fraction, LOG_FLOOR),
    quats: mixRotationsInto(take("quats", 4 * a.count), a.quats, b.quats, fraction),
    opacities,
    sh0: mixInto(take("sh0", 3 * a.count), a.sh0, b.sh0, fraction, -Infinity),
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

export function mix(a, b, fraction) {
  return a + (b - a) * fraction; // keeps equal values as they are
}

/** Values between two lists, both raised to a floor. */
function mixInto(result, a, b, fraction, floor) {
  for (let k = 0; k < result.length; k++) {
    const from = a[k] > floor ? a[k] : floor;
    const to = b[k] > floor ? b[k] : floor;
    result[k] = mix(from, to, fraction);
  }
  return result;
}

function mixRotationsInto(result, a, b, fraction) {
  for (let i = 0; i < result.length; i += 4) {
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
