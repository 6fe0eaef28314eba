/** Files of the page's configuration as meshes: .sog4d through the player, .gspk through the project's loader, others by Spark. */
import * as spark from "@sparkjsdev/spark";
import { decompress } from "fzstd";
import { readGspk, toSplatMesh } from "../../web/gspk.mjs";
import { Player } from "./sog4d/player.js";

const SPARK_TYPES = { ply: "ply", spz: "spz", splat: "splat", sog: "pcsogszip" };

/** Bytes of a file, from the server or from the page itself. */
export async function fetchBytes({ url, embedded }) {
  if (embedded) {
    const text = document.getElementById(embedded).textContent.trim();
    return (await fetch(`data:application/octet-stream;base64,${text}`)).arrayBuffer();
  }
  const response = await fetch(url);
  if (!response.ok) throw new Error(`the server answered ${response.status} ${response.statusText}`);
  return response.arrayBuffer();
}

/**
 * Open a file.
 *
 * @returns {Promise<{mesh: object, player: Player | null, degree: number, splats: number}>}
 */
export async function openSource(file) {
  const bytes = await fetchBytes(file);
  if (file.kind === "sog4d") {
    const player = await Player.open(new Blob([bytes]));
    return { mesh: player.mesh, player, degree: player.degree, splats: player.splatCount };
  }
  if (file.kind === "gspk") {
    const pack = await readGspk(bytes, { decompress });
    const mesh = toSplatMesh(spark, pack);
    await mesh.initialized;
    return { mesh, player: null, degree: Math.min(pack.degree, 3), splats: pack.count };
  }
  const mesh = new spark.SplatMesh({ fileBytes: bytes, fileType: SPARK_TYPES[file.kind], fileName: file.name });
  await mesh.initialized;
  const { numSplats } = mesh.packedSplats;
  if (file.splats && numSplats !== file.splats) {
    throw new Error(`Spark read ${numSplats} of ${file.splats} splats`);
  }
  return { mesh, player: null, degree: mesh.packedSplats.getNumSh(), splats: numSplats };
}
