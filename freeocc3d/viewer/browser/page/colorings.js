// Colors of voxels: as seen, by class, height, evidence or score; then those of the answers.

import { viridis } from "panels";

const NAMELESS = [150, 150, 160];

/**
 * Gives each voxel its color, and draws with it.
 * @param kind "color", "class", "height", "evidence" or "score".
 * @param about arrays and classes of the map; scene; scores (V,) of the answer ``answered``, if the source has them;
 *   regions [{rows, color, region, result}]; fade: whether what no region holds becomes pale.
 */
export function colorVoxels(voxels, kind, about) {
  const { colors, count } = voxels, { arrays, scene } = about;
  const put = (row, color) => colors.set(color, 4 * row);
  colors.fill(255);
  const table = Array.from({ length: 256 }, (_, k) => viridis(k / 255));
  if (kind === "class" && arrays.classes) {
    const palette = new Map(about.classes.map((each) => [each.number, each.color]));
    for (let row = 0; row < count; row += 1) put(row, palette.get(arrays.classes[row]) ?? NAMELESS);
  } else if (kind === "height") {
    const { low, high } = scene, T = scene.world.matrixWorld.elements;
    for (let row = 0; row < count; row += 1) {
      const [x, y, z] = voxels.center(row), height = T[2] * x + T[6] * y + T[10] * z + T[14];
      put(row, table[Math.round(255 * Math.min(Math.max((height - low.z) / (high.z - low.z), 0), 1))]);
    }
  } else if (kind === "evidence" || kind === "score") {
    const levels = kind === "score" ? scoreLevels(count, about) : evidenceLevels(arrays.hits);
    for (let row = 0; row < count; row += 1) put(row, table[levels[row]]);
  } else {
    for (let row = 0, at = 0; row < count; row += 1, at += 3) put(row, arrays.colors.subarray(at, at + 3));
  }
  if (kind !== "score") {
    if (about.fade) fade(colors);
    for (const { rows, color } of about.regions) for (const row of rows) put(row, color);
  }
  voxels.recolor();
}

/** What the colors of a kind mean, in words. */
export function describeColors(kind, answered) {
  if (kind === "evidence") return "dark: a few depth images end there; yellow: many";
  if (kind === "height") return "dark: low; yellow: high";
  if (kind !== "score") return "";
  return answered ? `score of '${answered.word}', dark 0 to yellow 1` : "ask for a word to see its score";
}

/** 0…255 by the number of depth images, on a logarithmic scale. */
function evidenceLevels(hits) {
  const most = Math.log1p(hits.reduce((a, b) => Math.max(a, b), 1));
  return Uint8Array.from(hits, (count) => Math.round((255 * Math.log1p(count)) / most));
}

/** 0…255 by the scores of the first answer; those of its regions, if the voxels' own are not there. */
function scoreLevels(count, { scores, answered, regions }) {
  if (scores) return scores;
  const levels = new Uint8Array(count);
  for (const { rows, region, result } of regions) {
    if (result === answered) for (const row of rows) levels[row] = Math.round(255 * region.score);
  }
  return levels;
}

function fade(colors) {
  for (let at = 0; at < colors.length; at += 4) {
    const gray = (colors[at] + colors[at + 1] + colors[at + 2]) / 3;
    for (let k = 0; k < 3; k += 1) colors[at + k] = 0.25 * colors[at + k] + 0.35 * gray + 86;
  }
}
