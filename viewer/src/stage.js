/** Draws one or two scenes with Spark: alone, side by side, or their difference; and exact pictures for given cameras. */
import * as spark from "@sparkjsdev/spark";
import * as THREE from "three";

export const DIFFERENCE_GAIN = 10;

export class Stage {
  constructor(canvas) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, alpha: false });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setClearColor(0x000000, 1);
    this.renderer.autoClear = false;
    this.sides = [];
    this.split = 0.5;
    this.mode = "first";
    this.difference = makeDifference();
  }

  /** Add a mesh as the next side. */
  add(mesh) {
    const scene = new THREE.Scene();
    const sparkRenderer = new spark.SparkRenderer({ renderer: this.renderer, enableLod: false });
    scene.add(sparkRenderer, mesh);
    this.sides.push({ scene, sparkRenderer, mesh });
  }

  /** Use at most so many SH bands. */
  limitDegree(degree) {
    for (const { mesh } of this.sides) {
      mesh.packedSplats.setMaxSh(degree);
      mesh.maxSh = degree;
      mesh.updateGenerator();
    }
  }

  /** Whether an order of the splats is still to come. */
  isBusy() {
    return this.sides.some(({ sparkRenderer: each }) => each.sorting || each.sortDirty || each.display !== each.current);
  }

  resize(width, height) {
    this.renderer.setSize(width, height, false);
    for (const target of this.difference.targets) {
      target.setSize(width * this.renderer.getPixelRatio(), height * this.renderer.getPixelRatio());
    }
  }

  /** Draw a picture of the page. */
  draw(camera) {
    const { renderer, sides } = this;
    const size = renderer.getSize(new THREE.Vector2());
    renderer.setScissorTest(false);
    renderer.clear();
    if (sides.length === 0) return;
    if (sides.length === 2 && this.mode === "split") {
      const edge = Math.round(size.x * this.split);
      renderer.setScissorTest(true);
      renderer.setScissor(0, 0, edge, size.y);
      renderer.render(sides[0].scene, camera);
      renderer.setScissor(edge, 0, size.x - edge, size.y);
      renderer.render(sides[1].scene, camera);
      renderer.setScissorTest(false);
    } else if (sides.length === 2 && this.mode === "difference") {
      sides.forEach(({ scene }, k) => {
        renderer.setRenderTarget(this.difference.targets[k]);
        renderer.clear();
        renderer.render(scene, camera);
      });
      renderer.setRenderTarget(null);
      renderer.render(this.difference.scene, this.difference.camera);
    } else {
      renderer.render(sides[this.mode === "second" ? 1 : 0].scene, camera);
    }
  }

  /**
   * RGBA bytes, bottom row first, of one side seen by a camera as `gsplat-inspect` writes it, sorted for that camera.
   */
  async capture(given, side = 0) {
    const { scene, sparkRenderer, mesh } = this.sides[side];
    const { renderer } = this;
    const [before, ratio] = [renderer.getSize(new THREE.Vector2()), renderer.getPixelRatio()];
    renderer.setPixelRatio(1);
    renderer.setSize(given.width, given.height, false);
    const camera = exactCamera(given);
    try {
      scene.updateMatrixWorld(true);
      mesh.updateMatrixWorld(true);
      sparkRenderer.autoUpdate = false;
      await sparkRenderer.update({ scene, camera });
      while (sparkRenderer.sorting || sparkRenderer.sortDirty || sparkRenderer.display !== sparkRenderer.current) {
        await new Promise((resolve) => setTimeout(resolve, 1));
      }
      renderer.setScissorTest(false);
      renderer.clear();
      renderer.render(scene, camera);
      const gl = renderer.getContext();
      const bytes = new Uint8Array(4 * given.width * given.height);
      gl.readPixels(0, 0, given.width, given.height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      return bytes;
    } finally {
      sparkRenderer.autoUpdate = true;
      renderer.setPixelRatio(ratio);
      renderer.setSize(before.x, before.y, false);
    }
  }
}

/**
 * A three.js camera (x right, y up, looking along -z) from a world-to-camera matrix with axes RDF and a K in pixels; the
 * matrices are set as they are: nothing is rounded through angles.
 */
export function exactCamera({ viewmat, K, width, height, near, far }) {
  const camera = new THREE.PerspectiveCamera(45, width / height, near, far);
  camera.matrixAutoUpdate = false;
  camera.matrix.set(...viewmat.flat()).premultiply(new THREE.Matrix4().makeScale(1, -1, -1)).invert();
  camera.updateMatrixWorld(true);
  const [[fx, , cx], [, fy, cy]] = K;
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

/**
 * A camera of the page as `gsplat-inspect render --camera` reads it.
 *
 * @param {number[][]} [world] rows of the matrix that brings the file's coordinates to those that are drawn
 */
export function describeCamera(camera, width, height, world) {
  camera.updateMatrixWorld(true);
  const view = new THREE.Matrix4().copy(camera.matrixWorld).invert().premultiply(new THREE.Matrix4().makeScale(1, -1, -1));
  if (world) view.multiply(new THREE.Matrix4().set(...world.flat()));
  const rows = [0, 1, 2, 3].map((row) => [0, 1, 2, 3].map((column) => view.elements[4 * column + row]));
  const focal = height / 2 / Math.tan(THREE.MathUtils.degToRad(camera.fov) / 2);
  const K = [
    [focal, 0, width / 2],
    [0, focal, height / 2],
    [0, 0, 1],
  ];
  return { viewmat: rows, K, width, height, near: camera.near, far: camera.far };
}

function makeDifference() {
  const targets = [0, 1].map(() => new THREE.WebGLRenderTarget(1, 1, { depthBuffer: false }));
  const material = new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3,
    uniforms: { first: { value: targets[0].texture }, second: { value: targets[1].texture } },
    vertexShader: "in vec3 position; out vec2 uv; void main() { uv = position.xy * 0.5 + 0.5; gl_Position = vec4(position, 1.0); }",
    fragmentShader: `precision highp float; uniform sampler2D first, second; in vec2 uv; out vec4 color;
      void main() { color = vec4(abs(texture(first, uv).rgb - texture(second, uv).rgb) * ${DIFFERENCE_GAIN.toFixed(1)}, 1.0); }`,
    depthTest: false,
    depthWrite: false,
  });
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  const scene = new THREE.Scene();
  scene.add(mesh);
  return { targets, scene, camera: new THREE.OrthographicCamera() };
}
