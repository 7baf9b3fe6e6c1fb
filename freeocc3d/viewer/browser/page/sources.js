// Where the page gets a map from: a server on this machine, or the page itself.

import { readEmbedded, readPacket } from "packets";

/** A sentence for people. */
export class Refusal extends Error {}

/** A map that a server shows. Each method raises Refusal with the server's sentence. */
export class ServedMap {
  constructor(number) {
    this.base = `./maps/${number}`;
    this.answersAnything = true;
  }

  async state() {
    return (await this.#fetch("state")).json();
  }

  async scene() {
    return readPacket(await (await this.#fetch("scene")).arrayBuffer());
  }

  async space() {
    return readPacket(await (await this.#fetch("space")).arrayBuffer());
  }

  /** @param question words, classes, negative, near, near_m, on, within: see answers.py. */
  async ask(question) {
    return readPacket(await (await this.#fetch("query", question)).arrayBuffer());
  }

  /** The keyframes that show a region of an answer best. */
  async views(answer, region) {
    return (await this.#fetch("views", { answer, region })).json();
  }

  async voxel(row) {
    return (await this.#fetch("voxel", { row })).json();
  }

  photograph(keyframe, version) {
    return `${this.base}/keyframes/${keyframe}.jpg?of=${version}`;
  }

  async #fetch(name, body) {
    const options = body && {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
    };
    let response;
    try {
      response = await fetch(`${this.base}/${name}`, options);
    } catch {
      throw new Refusal("The viewer's server does not answer: start 'freeocc3d view' again.");
    }
    if (!response.ok) {
      const told = await response.json().catch(() => ({}));
      throw new Refusal(told.error ?? `The viewer's server answered ${response.status}.`);
    }
    return response;
  }
}

/** A map that the page holds, with the answers to a fixed list of words. */
export class HeldMap {
  constructor(packet) {
    this.packet = packet;
    this.answersAnything = false;
  }

  async state() {
    return { version: (await this.#read()).meta.version };
  }

  scene() {
    return this.#read();
  }

  async space() {
    return this.#read();
  }

  async ask(question) {
    const { meta, arrays } = await this.#read();
    const results = [], rows = [];
    for (const word of question.words) {
      const known = meta.words.find((each) => each.word.toLowerCase() === word.trim().toLowerCase());
      if (known) {
        results.push(known);
        rows.push(arrays.answer_rows.subarray(known.from, known.to));
      } else {
        const note = `This file holds no answer to '${word}'. Pick a word of its list.`;
        results.push({ word, note, understood: "", regions: [] });
      }
    }
    for (const name of question.classes) {
      const result = this.#ofClass(name, meta, arrays);
      results.push(result);
      rows.push(result.rows);
    }
    const joined = new Uint32Array(rows.reduce((sum, each) => sum + each.length, 0));
    let at = 0;
    for (const each of rows) {
      joined.set(each, at);
      at += each.length;
    }
    return { meta: { results, version: meta.version, answer: 0 }, arrays: { rows: joined } };
  }

  async views(answer, number, region) {
    return region.views ?? [];
  }

  async voxel(row) {
    const { meta, arrays } = await this.#read();
    const keyframe = arrays.best_keyframe[row];
    const name = arrays.classes && meta.classes.find((each) => each.number === arrays.classes[row]);
    return {
      row,
      words: name ? [{ word: name.name }] : [],
      views: keyframe < meta.keyframes.length ? [{ keyframe, frame: meta.keyframes[keyframe] }] : [],
    };
  }

  /** @returns a promise of an image's address, or undefined if the file holds none of this keyframe. */
  photograph(keyframe) {
    const { photographs, photograph_ends: ends } = this.read.arrays;
    const from = keyframe ? ends[keyframe - 1] : 0;
    if (from === ends[keyframe]) return undefined;
    return URL.createObjectURL(new Blob([photographs.subarray(from, ends[keyframe])], { type: "image/jpeg" }));
  }

  async #read() {
    this.read ??= await readEmbedded(this.packet);
    return this.read;
  }

  #ofClass(name, meta, arrays) {
    const found = meta.classes.find((each) => each.name === name);
    const rows = [];
    arrays.classes?.forEach((number, row) => number === found?.number && rows.push(row));
    const { origin, unit } = meta.voxels;
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity], sum = [0, 0, 0];
    let volume = 0;
    for (const row of rows) {
      const edge = arrays.voxels[4 * row + 3];
      volume += (edge * unit) ** 3;
      for (let axis = 0; axis < 3; axis += 1) {
        const from = origin[axis] + arrays.voxels[4 * row + axis] * unit;
        low[axis] = Math.min(low[axis], from);
        high[axis] = Math.max(high[axis], from + edge * unit);
        sum[axis] += from + 0.5 * edge * unit;
      }
    }
    const region = {
      name, score: 1, confidence: 1, centroid: sum.map((value) => value / rows.length), box_min: low, box_max: high,
      volume_m3: volume, voxels: rows.length,
    };
    return { word: name, understood: name, note: "", color: found?.color, regions: rows.length ? [region] : [], rows };
  }
}
