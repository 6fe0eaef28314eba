/** Decodes keyframes of one bundle; asked through a port by the player's worker. */
import decode, { init } from "@jsquash/webp/decode";
import wasmAddress from "@jsquash/webp/codec/dec/webp_dec.wasm?url&inline";
import { Bundle } from "./bundle.js";

let bundle;

onmessage = async ({ data: { blob, port } }) => {
  const opened = (async () => {
    await init(await WebAssembly.compile(await (await fetch(wasmAddress)).arrayBuffer()));
    bundle = await Bundle.open(blob, decode, { hasPalettes: false });
  })();
  port.onmessage = async ({ data: { frame, path } }) => {
    const key = path ?? frame;
    try {
      await opened;
      if (path !== undefined) {
        const pixels = new Uint8Array(await bundle.pixels(path));
        port.postMessage({ key, pixels }, [pixels.buffer]);
        return;
      }
      // Only the positions are sure to be this keyframe's own: the rest is copied, since later ones may share it.
      const keyframe = await bundle.keyframe(frame);
      port.postMessage({ key, keyframe }, [keyframe.means.buffer]);
    } catch (error) {
      port.postMessage({ key, error: String(error?.message ?? error) });
    }
  };
};
