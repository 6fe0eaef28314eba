// Prints the licences of every package whose code is in the page.
import fs from "node:fs";

const packages = ["three", "@sparkjsdev/spark", "@zip.js/zip.js", "@jsquash/webp", "fzstd"];
for (const name of packages) {
  const folder = new URL(`node_modules/${name}/`, import.meta.url);
  const { version, license, homepage } = JSON.parse(fs.readFileSync(new URL("package.json", folder), "utf-8"));
  const files = fs.readdirSync(folder).filter((file) => /^(licen[cs]e|copying)/i.test(file));
  const codecs = name === "@jsquash/webp" ? ["codec/LICENSE.codec.md"].filter((file) => fs.existsSync(new URL(file, folder))) : [];
  const texts = [...files, ...codecs].map((file) => fs.readFileSync(new URL(file, folder), "utf-8").trim());
  console.log(`${"=".repeat(80)}\n${name} ${version} (${license})${homepage ? `\n${homepage}` : ""}\n\n${texts.join("\n\n")}\n`);
}
