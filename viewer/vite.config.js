import { defineConfig } from "vite";
import { viteSingleFile } from "vite-plugin-singlefile";

// One page that needs nothing else: the package carries it, the command serves it or puts files into it.
export default defineConfig({
  base: "./",
  plugins: [viteSingleFile()],
  worker: { format: "iife" },
  build: { outDir: "../gsplat_tools/viewing/page", emptyOutDir: true, target: "es2022", chunkSizeWarningLimit: 8192 },
});
