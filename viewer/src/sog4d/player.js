/** A .sog4d bundle in the page: workers that decode and evaluate, and the Spark mesh that shows a time. */
import * as spark from "@sparkjsdev/spark";
import DecoderWorker from "./decoder.worker.js?worker&inline";
import PlayerWorker from "./player.worker.js?worker&inline";
import { paddedCount } from "./pack.js";

const MOST_DECODERS = 4;
const KEYFRAMES_AHEAD = 6;
const KEYFRAMES_BEHIND = 2;

export class Player {
  /** Open a bundle from a Blob. */
  static async open(blob) {
    const player = new Player();
    const count = Math.max(1, Math.min(MOST_DECODERS, navigator.hardwareConcurrency || 1));
    const ports = [];
    for (let k = 0; k < count; k++) {
      const { port1, port2 } = new MessageChannel();
      const worker = new DecoderWorker();
      worker.onerror = player.fail;
      worker.postMessage({ blob, port: port1 }, [port1]);
      player.workers.push(worker);
      ports.push(port2);
    }
    const { facts } = await player.call({ type: "open", blob, ports }, ports);
    Object.assign(player, facts, { facts });
    player.splats = new spark.PackedSplats({
      packedArray: new Uint32Array(4 * paddedCount(facts.splatCount)),
      numSplats: facts.splatCount,
      splatEncoding: facts.encoding,
    });
    player.mesh = new spark.SplatMesh({ packedSplats: player.splats, splatEncoding: facts.encoding });
    await player.mesh.initialized;
    return player;
  }

  constructor() {
    this.workers = [];
    this.waiting = new Map();
    this.lastId = 0;
    this.decoded = 0;
    this.worker = new PlayerWorker();
    this.workers.push(this.worker);
    // A worker that does not run answers nothing: everybody who waits is told.
    this.fail = ({ message }) => {
      for (const { reject } of this.waiting.values()) reject(new Error(`a worker failed: ${message}`));
      this.waiting.clear();
    };
    this.worker.onerror = this.fail;
    this.worker.onmessage = ({ data: { id, error, ...answer } }) => {
      const { resolve, reject } = this.waiting.get(id);
      this.waiting.delete(id);
      if (error) reject(new Error(error));
      else resolve(answer);
    };
  }

  call(message, transfer = []) {
    const id = ++this.lastId;
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject });
      this.worker.postMessage({ id, ...message }, transfer);
    });
  }

  /** Normalized time of each keyframe. */
  get keyTimes() {
    return this.times ?? Array.from({ length: this.frameCount }, (_, k) => k / Math.max(1, this.frameCount - 1));
  }

  /** Bring the mesh to a normalized time; resolves once its arrays are those of that time. */
  async show(t, interpolation = "linear") {
    const around = { ahead: KEYFRAMES_AHEAD, behind: KEYFRAMES_BEHIND };
    const { packedArray, extra, decoded } = await this.call({ type: "show", t, interpolation, ...around });
    this.decoded = decoded;
    this.splats.packedArray.set(packedArray);
    for (const [name, words] of Object.entries(extra)) this.replaceBand(name, words);
    this.splats.needsUpdate = true;
    this.mesh.updateVersion();
  }

  /** Spark makes the texture of a band once, from the array that is there then: later words go into that array. */
  replaceBand(name, words) {
    const { extra } = this.splats;
    const texture = extra[`${name}Texture`]?.value;
    if (texture) {
      extra[name].set(words);
      texture.needsUpdate = true;
    } else extra[name] = words;
  }

  dispose() {
    for (const worker of this.workers) worker.terminate();
    this.mesh?.dispose();
  }
}
