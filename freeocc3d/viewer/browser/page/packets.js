// Reads packets: a JSON document and named arrays; see packets.py for the layout.

const KINDS = { Uint8Array, Uint16Array, Uint32Array, Int8Array, Int16Array, Int32Array, Float32Array };

/** @param {ArrayBuffer} buffer @returns {{meta: object, arrays: Object<string, TypedArray>}} arrays share the buffer. */
export function readPacket(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  const start = 8 * Math.ceil((4 + length) / 8);
  const arrays = {};
  for (const [name, { type, shape, at }] of Object.entries(header.arrays)) {
    arrays[name] = new KINDS[type](buffer, start + at, shape.reduce((product, side) => product * side, 1));
  }
  return { meta: header.meta, arrays };
}

/** Reads a packet that stands in the page: gzip in base64. */
export async function readEmbedded(text) {
  const bytes = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return readPacket(await new Response(stream).arrayBuffer());
}
