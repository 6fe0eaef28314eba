// What the page can be asked to do: each exported function takes (settings, blobs) and returns {report, bytes}.
import * as spark from "@sparkjsdev/spark";
import { decompress } from "fzstd";
import * as THREE from "three";
import { paddedCount, readGspk as read, toSplatMesh } from "/web/gspk.mjs";

let renderer;

/** Draw the words that Python handed over, as they are; the pixels come back as RGBA bytes, bottom row first. */
export async function drawPacked(settings, blobs) {
  const extra = {};
  for (const band of ["sh1", "sh2", "sh3"]) {
    if (blobs[band]) extra[band] = new Uint32Array(blobs[band]);
  }
  const splats = new spark.PackedSplats({
    packedArray: new Uint32Array(blobs.packed),
    numSplats: settings.numSplats,
    extra,
    ...(settings.splatEncoding ? { splatEncoding: settings.splatEncoding } : {}),
  });
  // SplatMesh overwrites the encoding of the PackedSplats it is given, with the defaults if it is told nothing.
  return draw(new spark.SplatMesh({ packedSplats: splats, splatEncoding: splats.splatEncoding }), settings);
}

/** Draw a .gspk file as a page would: read by web/gspk.mjs, drawn by Spark. */
export async function drawGspk(settings, { file }) {
  return draw(toSplatMesh(spark, await read(file, { decompress })), settings);
}

/** What web/gspk.mjs makes of a file; `settings.array` names the array whose bytes come back, as a path such as "extra.sh1". */
export async function readGspk({ array, withoutDecompressor = false, options = {} }, { file }) {
  const pack = await read(file, withoutDecompressor ? options : { decompress, ...options });
  const find = (path) => path.split(".").reduce((value, key) => value?.[key], pack);
  const found = array ? find(array) : new Uint8Array();
  if (!ArrayBuffer.isView(found)) throw new Error(`the pack has no array ${array}`);
  const describe = (value) =>
    ArrayBuffer.isView(value) ? { type: value.constructor.name, length: value.length, isView: value.buffer === file } : value;
  const describeAll = (values) => Object.fromEntries(Object.entries(values).map(([key, value]) => [key, describe(value)]));
  const report = {
    ...describeAll(pack),
    extra: describeAll(pack.extra ?? {}),
    motion: pack.motion && describeAll(pack.motion),
  };
  return { report, bytes: new Uint8Array(found.buffer, found.byteOffset, found.byteLength) };
}

/** How many splats web/gspk.mjs makes room for. */
export async function padCounts({ counts }) {
  return { report: { padded: counts.map(paddedCount) } };
}

/** What is drawing: versions and the GL behind the pixels. */
export async function describeRenderer() {
  const gl = getRenderer().getContext();
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  return {
    report: {
      three: THREE.REVISION,
      agent: navigator.userAgent,
      gl: gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER),
      maxTextureSize: gl.getParameter(gl.MAX_TEXTURE_SIZE),
    },
  };
}

/** The defaults of SparkRenderer, as it reports them itself. */
export async function sparkDefaults() {
  const sparkRenderer = new spark.SparkRenderer({ renderer: getRenderer() });
  const report = {};
  for (const [name, value] of Object.entries(sparkRenderer)) {
    if (["number", "boolean"].includes(typeof value)) report[name] = value;
  }
  report.premultipliedAlpha = sparkRenderer.premultipliedAlpha;
  sparkRenderer.dispose();
  return { report };
}

async function draw(mesh, { camera: given, options, background }) {
  const canvas = getRenderer();
  canvas.setSize(given.width, given.height, false);
  canvas.setClearColor(new THREE.Color().setRGB(...background.slice(0, 3), THREE.SRGBColorSpace), background[3]);

  // autoUpdate off: the order is brought up to date here, once, before anything is drawn, and not while drawing.
  const sparkRenderer = new spark.SparkRenderer({ renderer: canvas, enableLod: false, ...options, autoUpdate: false });
  const scene = new THREE.Scene();
  scene.add(sparkRenderer, mesh);
  try {
    await mesh.initialized;
    const camera = toThreeCamera(given);
    scene.updateMatrixWorld(true);
    await sparkRenderer.update({ scene, camera });
    await sorted(sparkRenderer);
    canvas.render(scene, camera);
    const gl = canvas.getContext();
    const bytes = new Uint8Array(4 * given.width * given.height);
    gl.readPixels(0, 0, given.width, given.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    const error = gl.getError();
    if (error !== gl.NO_ERROR) throw new Error(`WebGL error ${error}`);
    const { numSplats, splatEncoding } = mesh.packedSplats;
    return {
      report: { numSplats, splatEncoding, numSh: mesh.packedSplats.getNumSh(), activeSplats: sparkRenderer.activeSplats },
      bytes,
    };
  } finally {
    scene.remove(sparkRenderer, mesh);
    mesh.dispose();
    sparkRenderer.dispose();
  }
}

/** Wait until Spark's worker has sorted the splats for the camera of the last update. */
async function sorted(sparkRenderer) {
  while (sparkRenderer.sorting || sparkRenderer.sortDirty || sparkRenderer.display !== sparkRenderer.current) {
    await new Promise((resolve) => setTimeout(resolve, 1));
  }
}

/**
 * A three.js camera (x right, y up, looking along -z) from a world-to-camera matrix with axes RDF and a K in pixels.
 * The matrices are set as they are: nothing is rounded through angles.
 */
function toThreeCamera({ viewmat, K, width, height, near, far }) {
  const camera = new THREE.PerspectiveCamera(45, width / height, near, far);
  const flip = new THREE.Matrix4().makeScale(1, -1, -1);
  camera.matrixAutoUpdate = false;
  // prettier-ignore
  camera.matrix.set(...viewmat).premultiply(flip).invert();
  camera.updateMatrixWorld(true);
  const [fx, , cx, , fy, cy] = K;
  const depth = far - near;
  // prettier-ignore
  camera.projectionMatrix.set(
    (2 * fx) / width, 0, 1 - (2 * cx) / width, 0,
    0, (2 * fy) / height, (2 * cy) / height - 1, 0,
    0, 0, -(far + near) / depth, (-2 * far * near) / depth,
    0, 0, -1, 0,
  );
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  return camera;
}

function getRenderer() {
  if (!renderer) {
    renderer = new THREE.WebGLRenderer({ antialias: false, alpha: true, premultipliedAlpha: true });
    renderer.setPixelRatio(1);
  }
  return renderer;
}
