/**
 * Evaluates one bundle at the times that the page shows: keeps decoded keyframes, fetches the next ones ahead of the
 * playhead from the decoders, and packs what is shown into Spark's words.
 */
import { Bundle } from "./bundle.js";
import { evaluate, evaluateRest } from "./evaluate.js";
import { Packer } from "./pack.js";

const CACHE_BYTES = 256 * 2 ** 20;
const FEWEST_CACHED = 4;
const KEYFRAME_BYTES = 48; // a splat, about: positions, scales, rotation, opacity, color, labels

let bundle, packer, ports, cacheFrames;
let decoded = 0;
const cache = new Map(); // frame -> promise of a keyframe, least recently used first
const waiting = new Map(); // key -> {resolve, reject}
let nextPort = 0;
const room = {}; // arrays of the evaluation, written again for every picture

onmessage = async ({ data }) => {
  const { id, type } = data;
  try {
    const [answer, transfer] = await handlers[type](data);
    postMessage({ id, ...answer }, transfer);
  } catch (error) {
    postMessage({ id, error: String(error?.message ?? error) });
  }
};

const handlers = {
  /** Read the directory, meta.json and palettes. */
  async open({ blob, ports: given }) {
    ports = given;
    for (const port of ports) port.onmessage = ({ data }) => settle(data);
    bundle = await Bundle.open(blob, () => Promise.reject(new Error("images are decoded elsewhere")));
    packer = new Packer(bundle);
    cacheFrames = Math.max(FEWEST_CACHED, Math.floor(CACHE_BYTES / (KEYFRAME_BYTES * bundle.splatCount)));
    const { splatCount, frameCount, degree, times, rangeMin, rangeMax } = bundle;
    return [{ facts: { splatCount, frameCount, degree, times, rangeMin, rangeMax, encoding: packer.encoding } }, []];
  },

  /** Words for a time, and a start on the keyframes that come next. */
  async show({ t, interpolation, ahead, behind }) {
    const [a, b, fraction] = await bracketed(t, interpolation);
    const { frameCount } = bundle;
    const spare = Math.min(cacheFrames, frameCount) - 2; // what is fetched must not push out what is shown
    const later = Math.min(ahead, spare);
    const earlier = Math.min(behind, spare - later);
    for (let k = 1; k <= later; k++) prefetch((b.frame + k) % frameCount);
    for (let k = 1; k <= earlier; k++) prefetch((a.frame - k + frameCount) % frameCount);
    const { packedArray, extra } = packer.pack(evaluate(a, b, fraction, room), a, b, fraction);
    return [{ packedArray, extra, decoded }, []];
  },

  /** The evaluated values themselves, for comparison with the Python evaluation. */
  async values({ t, interpolation }) {
    const [a, b, fraction] = await bracketed(t, interpolation);
    const rest = evaluateRest(bundle.palettes, bundle.restCoefficients, a, b, fraction);
    return [{ ...evaluate(a, b, fraction), rest }, []];
  },

  /** The bytes of one image. */
  async pixels({ path }) {
    return [{ pixels: (await ask({ path })).pixels }, []];
  },

  /** Decode so many keyframes one after another from the start and tell the seconds. */
  async race({ frames }) {
    cache.clear();
    const start = performance.now();
    const wanted = Array.from({ length: frames }, (_, k) => ask({ frame: k % bundle.frameCount }));
    await Promise.all(wanted);
    return [{ seconds: (performance.now() - start) / 1000 }, []];
  },
};

async function bracketed(t, interpolation) {
  const [first, second, fraction] = bundle.bracket(t);
  const isBetween = interpolation === "linear" && fraction > 0;
  const a = keyframe(first);
  const b = isBetween ? keyframe(second) : a;
  return [await a, await b, isBetween ? fraction : 0];
}

function keyframe(frame) {
  const found = cache.get(frame) ?? ask({ frame }).then(({ keyframe }) => keyframe);
  found.catch(() => cache.delete(frame)); // asked for again, it is tried again
  cache.delete(frame);
  cache.set(frame, found);
  for (const oldest of cache.keys()) {
    if (cache.size <= cacheFrames) break;
    cache.delete(oldest);
  }
  return found;
}

function prefetch(frame) {
  if (!cache.has(frame) && waiting.size < 2 * ports.length) keyframe(frame).catch(() => {});
}

/** Ask the next decoder; answers are told apart by what was asked for. */
function ask({ frame, path }) {
  const key = path ?? frame;
  const known = waiting.get(key);
  if (known) return known.promise;
  const entry = {};
  entry.promise = new Promise((resolve, reject) => Object.assign(entry, { resolve, reject }));
  waiting.set(key, entry);
  ports[nextPort++ % ports.length].postMessage({ frame, path });
  return entry.promise;
}

function settle({ key, error, ...answer }) {
  const entry = waiting.get(key);
  waiting.delete(key);
  if (error) entry.reject(new Error(error));
  else {
    if (answer.keyframe) decoded++;
    entry.resolve(answer);
  }
}
