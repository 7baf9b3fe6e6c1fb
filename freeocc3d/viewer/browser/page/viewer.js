// The viewer of one map.

import * as THREE from "three";
import { Answers, splitWords } from "answers";
import { DraggedBox, FoundBoxes, floorGrid } from "boxes";
import { CameraPath } from "camera_path";
import { colorVoxels, describeColors } from "colorings";
import { DrawnScene } from "drawn_scene";
import { listenToKeys } from "navigation";
import { Photograph, byId, say, showFacts, theme } from "panels";
import { linkFrame, tellWords } from "linked_frames";
import { HeldMap, Refusal, ServedMap } from "sources";
import { Splats } from "splats";
import { Voxels } from "voxels";

const POLL_MS = 1500, CLICK_PX = 5, NARROW_PX = 760;
const UNSEEN = [150, 150, 160], FREE = [90, 170, 220];

class Viewer {
  constructor(source, embedded) {
    this.source = source;
    this.embedded = embedded;
    this.scene = new DrawnScene(byId("canvas"));
    this.answers = new Answers(byId("panel"));
    this.found = new FoundBoxes(this.scene, byId("labels"));
    this.box = new DraggedBox(this.scene, (corners) => {
      this.answers.box = corners;
      this.answers.ask();
    });
    this.photograph = new Photograph();
    this.photograph.panel.addEventListener("hidden", () => this.path?.choose(undefined));
    this.results = [];
    this.regions = [];
    this.keyframe = 0;
    this.asked = 0;
    this.#listen();
    theme((dark) => {
      this.scene.setBackground(getComputedStyle(document.documentElement).getPropertyValue("--scene").trim(), dark);
      if (this.meta) this.#drawGrid();
    });
  }

  /** Loads what the map's folder holds now; keeps the camera if the map was shown before. */
  async load() {
    const { meta, arrays } = await this.source.scene();
    const first = !this.meta?.voxels.count || this.meta.upright !== meta.upright;
    this.meta = meta;
    this.arrays = arrays;
    this.#clear();
    if (!first) this.photograph.hide();
    document.title = `${meta.title} – freeocc3d`;
    byId("title").textContent = meta.title;
    byId("counts").textContent = meta.live ? `${meta.live}. ${meta.voxels.count.toLocaleString("en")} voxels` : `${meta.voxels.count.toLocaleString("en")} voxels of `
      + `${meta.voxels.sizes.map((size) => this.#round(meta.metric ? 100 * size : size)).join(", ")} ${meta.metric ? "cm" : "units"}, `
      + `${meta.gaussians.drawn.toLocaleString("en")} Gaussians, ${meta.frames.posed} of ${meta.frames.all} frames`;
    this.voxels = new Voxels(arrays.voxels, meta.voxels);
    this.splats = new Splats(arrays);
    this.#place(first);
    this.path = new CameraPath(arrays, this.scene.size);
    this.scene.world.add(this.voxels.mesh, this.splats.mesh, this.path.group);
    this.scene.layers = [this.voxels, this.splats];
    this.space = undefined;
    this.#drawGrid();
    this.#setUp();
    [this.results, this.regions, this.scores] = [[], [], undefined]; // those of another map have other rows
    this.found.show([]);
    this.#recolor();
    this.#show();
    this.answers.showClasses(meta.classes);
    if (meta.no_classes) say(meta.no_classes);
    if (first) this.scene.overview(undefined, true);
    if (this.answers.question().words.length || this.answers.classes.size) await this.ask(this.answers.question());
  }

  async ask(question) {
    const number = (this.asked += 1);
    if (!question.words.length && !question.classes.length) {
      this.#answered({ meta: { results: [] }, arrays: { rows: new Uint32Array(0) } });
      return;
    }
    this.answers.showBusy();
    try {
      const answer = await this.source.ask(question);
      if (number !== this.asked) return; // a later question was asked
      if (answer.meta.version !== this.meta.version) {
        await this.load();
        return;
      }
      this.#answered(answer);
    } catch (error) {
      if (number === this.asked) this.answers.showRefusal(this.#told(error));
    }
  }

  /** Looks again whether the map's folder has changed. */
  async follow() {
    try {
      const { version } = await this.source.state();
      if (this.meta?.version !== version) await this.load();
      if (this.lost) say("");
      this.lost = false;
    } catch (error) {
      this.lost = true;
      say(this.#told(error));
    }
    setTimeout(() => this.follow(), POLL_MS);
  }

  /** Shows a photograph. @param mark {box, color}: pixels to mark, in a CSS color. */
  async openKeyframe(keyframe, mark, note = "") {
    if (!this.path?.cameras[keyframe]) return; // of a map that was replaced
    this.path.choose(keyframe);
    this.scene.changed();
    this.keyframe = keyframe;
    const name = `Keyframe ${keyframe + 1} of ${this.path.count}, frame ${this.meta.keyframes[keyframe]}${note}`;
    this.photograph.show(this.source.photograph(keyframe, this.meta.version), name, this.path.cameras[keyframe], mark);
  }

  #told(error) {
    if (!(error instanceof Refusal)) throw error;
    return error.message;
  }

  #round(value) {
    return Number(value.toPrecision(3)).toString();
  }

  get #lengths() {
    const unit = this.meta.metric ? "m" : "units";
    return {
      unit,
      number: (value) => value.toFixed(2),
      volume: (value) => (this.meta.metric ? `${(1000 * value).toFixed(1)} l` : `${this.#round(value)} units³`),
    };
  }

  #clear() {
    for (const each of [this.voxels, this.splats, this.path, this.space?.free, this.space?.unknown]) each?.dispose();
    this.grid?.removeFromParent();
  }

  /** Finds what the map reaches over, upright, and lets the camera know. */
  #place() {
    const { origin, unit } = this.meta.voxels, T = new THREE.Matrix4().set(...this.meta.T_view_map.flat());
    const sides = [[], [], []], { voxels } = this.arrays, step = Math.max(1, Math.floor(this.voxels.count / 20000));
    for (let row = 0; row < this.voxels.count; row += step) {
      const center = new THREE.Vector3(...this.voxels.center(row)).applyMatrix4(T);
      [center.x, center.y, center.z].forEach((value, axis) => sides[axis].push(value));
    }
    const { path } = this.arrays;
    if (!sides[0].length) for (let at = 0; at < path.length; at += 3) {
      const point = new THREE.Vector3(path[at], path[at + 1], path[at + 2]).applyMatrix4(T);
      [point.x, point.y, point.z].forEach((value, axis) => sides[axis].push(value));
    }
    const [low, high] = [0.004, 0.996].map((share) => new THREE.Vector3(...sides.map((values) => {
      values.sort((a, b) => a - b);
      return values.length ? values[Math.floor(share * (values.length - 1))] : 0;
    })));
    const half = 0.5 * unit * Math.max(...(voxels.length ? [voxels[3]] : [1]));
    this.scene.place(this.meta.T_view_map, low.subScalar(half), high.addScalar(half));
  }

  #drawGrid() {
    this.grid?.removeFromParent();
    const { lines, step } = floorGrid(this.scene.low, this.scene.high, this.scene.dark);
    this.grid = lines;
    this.grid.visible = byId("show-grid").checked;
    this.scene.scene.add(lines);
    byId("grid-step").textContent = `${this.#round(step)} ${this.meta.metric ? "m" : step === 1 ? "unit" : "units"}`;
    this.scene.changed();
  }

  /** Fits the controls to the map. */
  #setUp() {
    const cut = byId("cut"), { low, high } = this.scene;
    const kept = Number(cut.max) > Number(cut.min) && this.cutTouched ? Number(cut.value) : undefined;
    [cut.min, cut.max, cut.step] = [low.z.toFixed(3), (high.z + 0.01 * this.scene.size).toFixed(3), "any"];
    cut.value = kept ?? (low.z + 0.8 * (high.z - low.z)).toFixed(3);
    this.#cut();
    const colors = byId("colors"), chosen = colors.value;
    for (const option of colors.options) {
      option.disabled = option.value === "class" && !this.arrays.classes;
    }
    colors.value = colors.selectedOptions[0]?.disabled ? "color" : chosen;
    for (const id of ["show-free", "show-unknown"]) byId(id).disabled = !this.source.answersAnything && !this.arrays.free;
    const words = byId("known-words");
    words.replaceChildren(...(this.meta.words ?? this.meta.classes.filter((each) => each.number)).map((each) => {
      const option = document.createElement("option");
      option.value = each.word ?? each.name;
      return option;
    }));
    for (const each of document.querySelectorAll(".asks-anything")) each.hidden = !this.source.answersAnything;
  }

  #cut() {
    const cut = Number(byId("cut").value), all = cut >= Number(byId("cut").max) - 1e-6;
    for (const each of [this.voxels, this.splats, this.space?.free, this.space?.unknown]) {
      if (each) each.cut = all ? Infinity : cut;
    }
    byId("cut-told").textContent = all ? "all" : `${cut.toFixed(2)} ${this.#lengths.unit}`;
    this.scene.changed();
  }

  #recolor() {
    const kind = byId("colors").value;
    colorVoxels(this.voxels, kind, {
      arrays: this.arrays, classes: this.meta.classes, scene: this.scene, scores: this.scores,
      answered: this.results[0], regions: this.regions, fade: this.results.length > 0 && byId("fade").checked,
    });
    byId("legend").textContent = describeColors(kind, this.results[0]);
    this.scene.changed();
  }

  #answered({ meta, arrays }) {
    this.results = meta.results;
    this.answer = meta.answer;
    this.scores = arrays.scores?.subarray(0, this.voxels.count);
    this.regions = [];
    let at = 0;
    for (const result of meta.results) for (const region of result.regions) {
      const rows = arrays.rows.subarray(at, at + region.voxels), number = this.regions.length;
      this.regions.push({ rows, region, result, color: result.color ?? [255, 80, 40], number });
      at += region.voxels;
    }
    this.answers.show(meta.results, this.#lengths, (region) => this.#away(region));
    this.found.show(this.regions.slice(0, 40).map(({ region, result, color, number }) => ({
      region, color, name: result.word, choose: () => this.answers.choose(number),
    })));
    this.#recolor();
  }

  #away(region) {
    const away = this.scene.toView(region.centroid).distanceTo(this.scene.camera.position);
    return `${away.toFixed(1)} ${this.#lengths.unit} away`;
  }

  /** A region of the list was chosen: fly there, and show the photograph that shows it best. */
  async #choose({ region, result, number }) {
    const corners = [region.box_min, region.box_max].map((corner) => this.scene.toView(corner));
    const low = corners[0].clone().min(corners[1]), high = corners[0].clone().max(corners[1]);
    this.scene.approach(low, high);
    this.chosen = { low, high };
    try {
      const views = await this.source.views(this.answer, number, region);
      const [best] = views;
      const color = `rgb(${(result.color ?? [255, 80, 40]).join(", ")})`;
      if (best) this.openKeyframe(best.keyframe, { box: best.box, color }, ` shows ${Math.round(100 * best.visible)}% of it`);
      else this.photograph.hide();
    } catch (error) {
      say(this.#told(error));
    }
  }

  async #click(event) {
    const frame = this.scene.canvas.getBoundingClientRect();
    const ray = this.scene.rayAt(event.clientX, event.clientY);
    const voxel = this.voxels.mesh.visible ? this.voxels.pick(ray, this.scene.world.matrixWorld) : undefined;
    const keyframe = this.path.group.visible
      ? this.path.pick(this.scene, event.clientX - frame.left, event.clientY - frame.top) : undefined;
    if (keyframe && keyframe.distance < (voxel?.distance ?? Infinity) + 0.02 * this.scene.size) {
      this.openKeyframe(keyframe.keyframe);
    } else if (voxel) await this.#tell(voxel.row);
    else byId("facts").hidden = true;
  }

  async #tell(row) {
    const center = this.voxels.center(row), { arrays, meta } = this, unit = this.#lengths.unit;
    this.told = row;
    const name = meta.classes.find((each) => each.number === arrays.classes?.[row]);
    const facts = [
      ["Position", `${center.map((value) => value.toFixed(2)).join(", ")} ${unit}`],
      ["Edge", `${this.#round(arrays.voxels[4 * row + 3] * meta.voxels.unit)} ${unit}`],
      ["Occupied", `${Math.round((100 * arrays.probability[row]) / 255)}%; ${arrays.hits[row]} depth images end here, `
        + `${arrays.seen_through[row]} see through`],
    ];
    if (name) facts.push(["Class", name.name]);
    const found = this.regions.filter(({ rows }) => rows.includes(row)).map(({ result }) => result.word);
    if (found.length) facts.push(["Found as", found.join(", ")]);
    showFacts("Voxel", facts);
    try {
      const { words, views } = await this.source.voxel(row);
      if (this.told !== row) return;
      const fitting = words.map(({ word, cosine }) => (cosine === undefined ? word : `${word} ${cosine.toFixed(2)}`));
      if (fitting.length) facts.push(["Best words", fitting.join(", ")]);
      if (views.length) facts.push(["Shown by", this.#keyframeButtons(views)]);
      showFacts("Voxel", facts);
    } catch (error) {
      say(this.#told(error));
    }
  }

  #keyframeButtons(views) {
    const list = document.createElement("span");
    for (const { keyframe, frame, pixel } of views) {
      const button = document.createElement("button");
      button.textContent = `frame ${frame}`;
      const around = pixel && { box: [pixel[0] - 8, pixel[1] - 8, pixel[0] + 8, pixel[1] + 8], color: "#ff4020" };
      button.addEventListener("click", () => this.openKeyframe(keyframe, around));
      list.append(button);
    }
    return list;
  }

  async #show() {
    const on = (id) => byId(id).checked;
    this.voxels.mesh.visible = on("show-voxels");
    this.splats.mesh.visible = on("show-splats");
    this.path.group.visible = on("show-path");
    this.grid.visible = on("show-grid");
    if ((on("show-free") || on("show-unknown")) && !this.space) await this.#loadSpace();
    if (this.space) {
      this.space.free.mesh.visible = on("show-free");
      this.space.unknown.mesh.visible = on("show-unknown");
    }
    this.scene.changed();
  }

  async #loadSpace() {
    this.loadingSpace ??= this.source.space();
    let arrays;
    try {
      ({ arrays } = await this.loadingSpace);
    } catch (error) {
      say(this.#told(error));
      return;
    } finally {
      this.loadingSpace = undefined;
    }
    if (this.space) return;
    const made = (voxels, color, look) => {
      const each = new Voxels(voxels, this.meta.voxels, look);
      for (let row = 0; row < each.count; row += 1) each.colors.set([...color, 255], 4 * row);
      each.recolor();
      this.scene.world.add(each.mesh);
      this.scene.layers.push(each);
      return each;
    };
    this.space = {
      free: made(arrays.free, FREE, { opacity: 1, inset: 0.12 }),
      unknown: made(arrays.unknown, UNSEEN, { opacity: 0.35, inset: 0.8 }),
    };
    this.#cut();
  }

  #toggleBox() {
    const on = byId("within").checked, { low, high } = this.scene;
    if (on) {
      const corners = [low, high].map((corner, k) => this.scene.toMap(corner.clone().lerp(k ? low : high, 0.25)).toArray());
      this.answers.box = [0, 1, 2].map((k) => Math.min(corners[0][k], corners[1][k]))
        .concat([0, 1, 2].map((k) => Math.max(corners[0][k], corners[1][k])));
      this.answers.box = this.answers.box.map((value) => Number(value.toFixed(3)));
    } else this.answers.box = undefined;
    this.box.set(this.answers.box);
    this.answers.ask();
  }

  #listen() {
    const { answers, scene } = this;
    answers.addEventListener("asked", ({ detail }) => {
      this.ask(detail);
      if (this.embedded) tellWords(answers);
    });
    answers.addEventListener("chosen", ({ detail }) => this.#choose(detail));
    for (const id of ["show-voxels", "show-splats", "show-path", "show-grid", "show-free", "show-unknown"]) {
      byId(id).addEventListener("change", () => this.#show());
    }
    for (const id of ["colors", "fade"]) byId(id).addEventListener("change", () => this.#recolor());
    byId("cut").addEventListener("input", () => {
      this.cutTouched = true;
      this.#cut();
    });
    byId("within").addEventListener("change", () => this.#toggleBox());
    if (innerWidth <= NARROW_PX) for (const id of ["tools", "classes-details"]) byId(id).open = false;
    byId("overview").addEventListener("click", () => scene.overview());
    byId("look-from").addEventListener("click", () => this.path?.cameras[this.keyframe] && this.path.lookFrom(scene, this.keyframe));
    const turn = (by) => this.path && this.openKeyframe((this.keyframe + by + this.path.count) % this.path.count);
    byId("previous").addEventListener("click", () => turn(-1));
    byId("next").addEventListener("click", () => turn(1));
    byId("facts-close").addEventListener("click", () => { byId("facts").hidden = true; });
    byId("message").addEventListener("click", () => say(""));
    byId("help").addEventListener("click", () => byId("keys").showModal());
    byId("fold").addEventListener("click", () => {
      document.body.classList.toggle("folded");
      scene.fit();
    });
    let down;
    scene.canvas.addEventListener("pointerdown", (event) => { down = { x: event.clientX, y: event.clientY }; });
    scene.canvas.addEventListener("pointerup", (event) => {
      const still = down && Math.hypot(event.clientX - down.x, event.clientY - down.y) < CLICK_PX;
      if (still && event.button === 0 && this.voxels) this.#click(event);
      down = undefined;
    });
    scene.canvas.addEventListener("dblclick", (event) => this.#center(event));
    scene.addEventListener("rest", () => answers.updateDistances());
    scene.addEventListener("drawn", () => {
      const at = scene.camera.position.clone().sub(scene.controls.target);
      byId("needle").style.transform = `rotate(${Math.atan2(-at.y, -at.x)}rad)`;
    });
    const flip = (id) => () => byId(id).click();
    listenToKeys(scene, {
      "/": () => answers.form.elements.words.focus(), f: () => this.chosen && scene.approach(this.chosen.low, this.chosen.high),
      v: flip("show-voxels"), g: flip("show-splats"), p: flip("show-path"), t: flip("theme"), "?": flip("help"), h: flip("help"),
      c: () => this.#nextColors(), escape: () => {
        this.photograph.hide();
        byId("facts").hidden = true;
      },
    });
    if (this.embedded) linkFrame(scene, answers, () => this.ask(answers.question()));
  }

  #center(event) {
    if (!this.voxels) return;
    const hit = this.voxels.pick(this.scene.rayAt(event.clientX, event.clientY), this.scene.world.matrixWorld);
    if (!hit) return;
    const target = this.scene.toView(this.voxels.center(hit.row));
    const shift = target.clone().sub(this.scene.controls.target);
    this.scene.fly(this.scene.camera.position.clone().add(shift), target);
  }

  #nextColors() {
    const colors = byId("colors"), allowed = [...colors.options].filter((option) => !option.disabled);
    colors.value = allowed[(allowed.indexOf(colors.selectedOptions[0]) + 1) % allowed.length].value;
    this.#recolor();
  }
}

export async function start() {
  const held = byId("packet").textContent.trim(), asked = new URLSearchParams(location.search);
  const source = held ? new HeldMap(held) : new ServedMap(Number.parseInt(asked.get("map") ?? "0", 10));
  const viewer = new Viewer(source, !held && parent !== window);
  globalThis.freeocc3d = viewer;
  try {
    await viewer.load();
  } catch (error) {
    if (!(error instanceof Refusal)) throw error;
    say(error.message);
  }
  document.documentElement.dataset.ready = "true";
  const words = splitWords(asked.get("words") ?? JSON.parse(byId("told").textContent).ask ?? "");
  if (words.length) {
    viewer.answers.form.elements.words.value = words.join(", ");
    viewer.answers.ask();
  }
  if (source.answersAnything) setTimeout(() => viewer.follow(), POLL_MS);
}
