// Boxes around what was found, their names, the floor grid, and the box that is dragged.

import * as THREE from "three";

const EDGES = [[0, 1], [1, 3], [3, 2], [2, 0], [4, 5], [5, 7], [7, 6], [6, 4], [0, 4], [1, 5], [2, 6], [3, 7]];
const HANDLE_PX = 16, MOST_MOVED_PX = 70; // a name that would be farther from its thing is left out

function boxLines(corners, color) {
  const geometry = new THREE.BufferGeometry();
  const points = EDGES.flatMap((edge) => edge.map((k) => corners[k]));
  geometry.setFromPoints(points);
  return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color }));
}

function cornersOf(low, high) {
  return Array.from({ length: 8 }, (_, k) => new THREE.Vector3(
    k & 4 ? high[0] : low[0], k & 2 ? high[1] : low[1], k & 1 ? high[2] : low[2],
  ));
}

/** What was found: a box each, and its word as a label in the page. */
export class FoundBoxes {
  constructor(scene, labels) {
    this.scene = scene;
    this.labels = labels;
    this.group = new THREE.Group();
    scene.world.add(this.group);
    scene.addEventListener("drawn", () => this.#place());
    this.shown = [];
  }

  /** @param found [{region, color: [r, g, b], name, choose}] */
  show(found) {
    this.group.children.slice().forEach((child) => {
      child.geometry.dispose();
      child.material.dispose();
      child.removeFromParent();
    });
    this.labels.replaceChildren();
    this.shown = found.map(({ region, color, name, choose }) => {
      const css = `rgb(${color.join(", ")})`;
      this.group.add(boxLines(this.#corners(region), new THREE.Color(css)));
      const label = document.createElement("button");
      label.className = "label";
      label.textContent = name;
      label.style.setProperty("--word", css);
      label.addEventListener("click", choose);
      this.labels.append(label);
      return { label, at: new THREE.Vector3(region.centroid[0], region.centroid[1], region.box_max[2]) };
    });
    this.scene.changed();
  }

  #corners(region) {
    if (!region.T_map_box) return cornersOf(region.box_min, region.box_max);
    const T = new THREE.Matrix4().set(...region.T_map_box.flat()), half = region.extent.map((side) => side / 2);
    return cornersOf(half.map((side) => -side), half).map((corner) => corner.applyMatrix4(T));
  }

  #place() {
    const taken = [];
    for (const { label, at } of this.shown) {
      const place = this.scene.onScreen(at.clone().applyMatrix4(this.scene.world.matrixWorld));
      label.hidden = !place;
      if (!place) continue;
      let y = place.y;
      const width = label.offsetWidth + 4, height = label.offsetHeight + 2;
      while (taken.some((each) => Math.abs(each.x - place.x) < (each.width + width) / 2 && Math.abs(each.y - y) < height)) y -= height;
      label.hidden = place.y - y > MOST_MOVED_PX;
      if (label.hidden) continue;
      taken.push({ x: place.x, y, width });
      label.style.transform = `translate(-50%, -100%) translate(${place.x}px, ${y}px)`;
    }
  }
}

/** Lines on the floor, one a meter or a round number of units. */
export function floorGrid(low, high, dark) {
  const extent = Math.max(high.x - low.x, high.y - low.y, 1e-3), power = 10 ** Math.floor(Math.log10(extent / 4));
  const step = extent <= 60 && extent >= 2 ? 1 : [1, 2, 5, 10].map((k) => k * power).find((each) => extent / each <= 20);
  const [x0, x1, y0, y1] = [
    Math.floor(low.x / step), Math.ceil(high.x / step), Math.floor(low.y / step), Math.ceil(high.y / step),
  ].map((k) => k * step);
  const points = [];
  for (let x = x0; x <= x1 + 1e-9; x += step) points.push(new THREE.Vector3(x, y0, 0), new THREE.Vector3(x, y1, 0));
  for (let y = y0; y <= y1 + 1e-9; y += step) points.push(new THREE.Vector3(x0, y, 0), new THREE.Vector3(x1, y, 0));
  const lines = new THREE.LineSegments(
    new THREE.BufferGeometry().setFromPoints(points), new THREE.LineBasicMaterial({ color: dark ? 0x4a5058 : 0xb9bec5 }),
  );
  return { lines, step };
}

/** A box of the map's frame with a handle on each face. */
export class DraggedBox {
  /** @param changed is called with [x0, y0, z0, x1, y1, z1] when a handle is let go. */
  constructor(scene, changed) {
    this.scene = scene;
    this.changed = changed;
    this.group = new THREE.Group();
    this.group.visible = false;
    scene.world.add(this.group);
    const listen = (name, act) => scene.canvas.addEventListener(name, act, { capture: true });
    listen("pointerdown", (event) => this.#grab(event));
    listen("pointermove", (event) => this.#drag(event));
    listen("pointerup", (event) => this.#release(event));
    listen("pointercancel", (event) => this.#release(event));
  }

  /** @param corners x0 … z1, map frame; undefined hides the box. */
  set(corners) {
    this.corners = corners && [...corners];
    this.group.visible = corners !== undefined;
    this.#draw();
  }

  #draw() {
    this.group.children.slice().forEach((child) => {
      child.geometry.dispose();
      child.material.dispose();
      child.removeFromParent();
    });
    if (this.corners) {
      const low = this.corners.slice(0, 3), high = this.corners.slice(3);
      this.group.add(boxLines(cornersOf(low, high), 0xd9480f));
      for (let face = 0; face < 6; face += 1) {
        const ball = new THREE.Mesh(new THREE.SphereGeometry(0.008 * this.scene.size, 12, 8), new THREE.MeshBasicMaterial({ color: 0xd9480f }));
        ball.position.copy(this.#middle(face));
        this.group.add(ball);
      }
    }
    this.scene.changed();
  }

  #middle(face) {
    const middle = [0, 1, 2].map((axis) => 0.5 * (this.corners[axis] + this.corners[axis + 3]));
    middle[face % 3] = this.corners[face];
    return new THREE.Vector3(...middle);
  }

  #at(event) {
    const frame = this.scene.canvas.getBoundingClientRect();
    return { x: event.clientX - frame.left, y: event.clientY - frame.top };
  }

  #grab(event) {
    if (!this.corners || event.button !== 0) return;
    const { x, y } = this.#at(event);
    let nearest = HANDLE_PX;
    for (let face = 0; face < 6; face += 1) {
      const at = this.scene.onScreen(this.scene.toView(this.#middle(face).toArray()));
      const away = at ? Math.hypot(at.x - x, at.y - y) : Infinity;
      if (away < nearest) [nearest, this.face] = [away, face];
    }
    if (this.face === undefined) return;
    this.scene.canvas.setPointerCapture(event.pointerId);
    event.stopImmediatePropagation();
  }

  #drag(event) {
    if (this.face === undefined) return;
    event.stopImmediatePropagation();
    const axis = this.face % 3, { origin, direction } = this.scene.rayAt(event.clientX, event.clientY);
    const along = new THREE.Vector3().setComponent(axis, 1), from = this.#middle(this.face).sub(origin);
    const d = direction.dot(along), flat = 1 - d * d;
    if (flat < 1e-4) return;
    const shift = (d * direction.dot(from) - along.dot(from)) / flat; // nearest point of the axis to the ray
    const least = 0.005 * this.scene.size, other = this.corners[(this.face + 3) % 6];
    const moved = this.corners[this.face] + shift;
    this.corners[this.face] = this.face < 3 ? Math.min(moved, other - least) : Math.max(moved, other + least);
    this.#draw();
  }

  #release(event) {
    if (this.face === undefined) return;
    this.face = undefined;
    event.stopImmediatePropagation();
    this.changed(this.corners.map((value) => Number(value.toFixed(3))));
  }
}
