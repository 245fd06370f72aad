// Prints positions [3 N] and rotations xyzw [4 N] that a library reads from an .spz, as JSON.
// `node spz_readers.mjs LIBRARY FILE`, in a folder with its packages; see bench_spz_readers.py.
import { readFileSync } from "node:fs";
import { gunzipSync } from "node:zlib";

const [library, file] = process.argv.slice(2);
const bytes = new Uint8Array(readFileSync(file));
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
const adobe = async () => (await import("@adobe/spz")).default();

// Rows of 32 bytes as in a .splat: position, size, colour, and a rotation wxyz in bytes.
function fromRows(rows) {
  const [floats, raw] = [new Float32Array(rows), new Uint8Array(rows)];
  const positions = [], rotations = [];
  for (let i = 0; i < raw.length / 32; i += 1) {
    positions.push(...floats.slice(8 * i, 8 * i + 3));
    const [w, ...xyz] = [...raw.slice(32 * i + 28, 32 * i + 32)].map((b) => b / 127.5 - 1);
    rotations.push(...xyz, w);
  }
  return { positions, rotations };
}

const readers = {
  async three() {
    const { SPZLoader } = await import("three/examples/jsm/loaders/SPZLoader.js");
    const geometry = await new SPZLoader().parse(buffer);
    return { positions: [...geometry.attributes.position.array] };
  },
  // Babylon reads by Adobe's library, and without WebAssembly by code of its own.
  async babylon() {
    const { ConvertSpzToSplatAsync } = await import("@babylonjs/loaders/SPLAT/spz.js");
    const spz = await adobe();
    const cloud = spz.loadSpzFromBuffer(bytes, { to: spz.CoordinateSystem.RUB });
    const engine = { getCaps: () => ({ maxTextureSize: 4096 }) };
    return fromRows((await ConvertSpzToSplatAsync(cloud, { getEngine: () => engine })).data);
  },
  async "babylon-without-wasm"() {
    const { ParseSpz } = await import("@babylonjs/loaders/SPLAT/spz.js");
    const body = new Uint8Array(gunzipSync(bytes));
    const engine = { getCaps: () => ({ maxTextureSize: 4096 }) };
    return fromRows((await ParseSpz(body.buffer, { getEngine: () => engine })).data);
  },
  async adobe() {
    const spz = await adobe();
    const cloud = spz.loadSpzFromBuffer(bytes, { to: spz.CoordinateSystem.UNSPECIFIED });
    return { positions: [...cloud.positions], rotations: [...cloud.rotations] };
  },
};

console.log = () => {}; // Adobe's library prints what it does
process.stdout.write(JSON.stringify(await readers[library]()));
