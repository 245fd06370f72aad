// Harmonics for the graphics card, at full precision.
//
// Spark keeps the three channels of a coefficient as 8 bits each of a power of two. Version 2.2
// takes the power below the greatest of them and cuts them off there, up to half of each. Its
// shader takes any power; here it is the one above.

const HEADER = 16; // bytes of an SPZ file of version 3
const OTHERS = 20; // bytes a Gaussian that lie before its harmonics
const TERMS = [0, 3, 8, 15]; // coefficients a channel, by degree
const BIAS = 15; // of the exponent

// The power of two above a coefficient of 0 to 128, in 128ths.
const EXPONENTS = Array.from(
  { length: 129 }, (_, most) => Math.ceil(Math.log2(Math.max(most, 1) / 128)));

function word(red, green, blue) {
  const exponent = EXPONENTS[Math.max(Math.abs(red), Math.abs(green), Math.abs(blue))];
  const share = 255 / 128 / 2 ** exponent;
  const signs = (red < 0 ? 1 : 0) | (green < 0 ? 2 : 0) | (blue < 0 ? 4 : 0);
  return (Math.round(Math.abs(red) * share) | Math.round(Math.abs(green) * share) << 8 |
    Math.round(Math.abs(blue) * share) << 16 | ((exponent + BIAS) << 3 | signs) << 24) >>> 0;
}

// Writes the coefficients of an SPZ file of version 3, `bytes`, over those that Spark made of it:
// `extra` holds arrays of four words a Gaussian, degree 1 and the first of degree 2, and so on.
export async function restoreHarmonics(bytes, extra) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const file = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = new DataView(file.buffer).getUint32(8, true);
  const terms = TERMS[file[12]];
  const places = [
    [extra.sh1, 0, 4], [extra.sh2, 4, 8], [extra.sh3a, 8, 12], [extra.sh3b, 12, 15]];
  for (const [words, first, end] of places) {
    for (let n = 0; words && n < count; n++) {
      for (let term = first; term < Math.min(end, terms); term++) {
        const at = HEADER + OTHERS * count + 3 * (n * terms + term);
        words[4 * n + term - first] = word(
          file[at] - 128, file[at + 1] - 128, file[at + 2] - 128);
      }
    }
  }
}
