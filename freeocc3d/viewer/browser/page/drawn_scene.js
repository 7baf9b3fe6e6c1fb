// The canvas: renderer, camera, what is drawn, and when. A frame is drawn when something changed. While the camera
// moves, large maps are drawn in part, so that a slow machine follows the hand; at rest, in full.

import * as THREE from "three";

const SLOW_MS = 70, REST_MS = 150, FLIGHT_MS = 450, SMALLEST_SHARE = 0.02;

export class DrawnScene extends EventTarget {
  constructor(canvas) {
    super();
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
    this.scene = new THREE.Scene();
    this.world = new THREE.Group(); // holds what has coordinates of the map's frame
    this.world.matrixAutoUpdate = false;
    this.scene.add(this.world);
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.01, 100);
    this.camera.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.zoomToCursor = true;
    this.controls.addEventListener("change", () => this.moved());
    this.layers = []; // what is drawn with a share of its instances while the camera moves
    this.size = 1;
    this.frames = 0; // drawn in full
    this.dark = false;
    this.fullMs = 0;
    this.pending = 0;
    this.free = { x: 1, y: 1 }; // shares of the canvas that no panel covers
    new ResizeObserver(() => this.fit()).observe(canvas.parentElement);
    this.fit();
  }

  /** Draws in full soon. */
  changed() {
    this.pending ||= requestAnimationFrame(() => {
      this.pending = 0;
      this.#draw(this.resting === undefined ? 1 : this.#share());
    });
  }

  /** Draws soon, and in full when the camera rests. */
  moved() {
    clearTimeout(this.resting);
    this.resting = setTimeout(() => {
      this.resting = undefined;
      this.dispatchEvent(new Event("rest"));
      this.changed();
    }, REST_MS);
    this.changed();
  }

  setBackground(color, dark) {
    this.scene.background = new THREE.Color(color);
    this.dark = dark;
    this.changed();
  }

  /** @param T_view_map rows of a 4 x 4 matrix.  @param low, high corners of what is drawn, view frame. */
  place(T_view_map, low, high) {
    this.world.matrix.set(...T_view_map.flat());
    this.world.matrixWorldNeedsUpdate = true;
    this.world.updateMatrixWorld(true);
    this.low = low;
    this.high = high;
    this.size = Math.max(low.distanceTo(high), 1e-3);
    this.camera.near = 0.002 * this.size;
    this.camera.far = 20 * this.size;
    this.camera.updateProjectionMatrix();
  }

  toView(point) {
    return new THREE.Vector3(...point).applyMatrix4(this.world.matrixWorld);
  }

  toMap(vector) {
    return vector.clone().applyMatrix4(this.world.matrixWorld.clone().invert());
  }

  /** Looks at everything from a direction, by default down from a corner. */
  overview(direction = new THREE.Vector3(-0.5, -0.75, 0.9), now = false) {
    const middle = this.low.clone().add(this.high).multiplyScalar(0.5);
    const back = direction.clone().normalize();
    const right = new THREE.Vector3(0, 0, 1).cross(back).normalize();
    if (right.lengthSq() < 0.5) right.set(1, 0, 0);
    const up = back.clone().cross(right);
    const tan = Math.tan((this.camera.fov * Math.PI) / 360);
    const tanX = tan * this.camera.aspect * this.free.x, tanY = tan * this.free.y;
    let distance = 0.1;
    for (const x of [this.low.x, this.high.x]) for (const y of [this.low.y, this.high.y]) for (const z of [this.low.z, this.high.z]) {
      const corner = new THREE.Vector3(x, y, z).sub(middle);
      const sideways = Math.max(Math.abs(corner.dot(right)) / tanX, Math.abs(corner.dot(up)) / tanY);
      distance = Math.max(distance, sideways + corner.dot(back));
    }
    this.fly(middle.clone().addScaledVector(back, 1.04 * distance), middle, now);
  }

  /** Moves to where a box, view frame, fills a third of the view, from the side where the camera is. */
  approach(low, high, now = false) {
    const middle = low.clone().add(high).multiplyScalar(0.5);
    const back = this.camera.position.clone().sub(this.controls.target).normalize();
    back.z = Math.max(back.z, 0.35);
    const distance = Math.max(1.7 * low.distanceTo(high), 0.12 * this.size);
    this.fly(middle.clone().addScaledVector(back.normalize(), distance), middle, now);
  }

  fly(position, target, now = false) {
    cancelAnimationFrame(this.flight);
    const fromPosition = this.camera.position.clone(), fromTarget = this.controls.target.clone();
    const still = now || matchMedia("(prefers-reduced-motion: reduce)").matches;
    const start = performance.now();
    const step = (time) => {
      const share = still ? 1 : Math.min((time - start) / FLIGHT_MS, 1), eased = share * share * (3 - 2 * share);
      this.camera.position.lerpVectors(fromPosition, position, eased);
      this.controls.target.lerpVectors(fromTarget, target, eased);
      this.controls.update();
      this.moved();
      if (share < 1) this.flight = requestAnimationFrame(step);
    };
    step(start);
  }

  /** The ray through a pixel of the window, in the map's frame: {origin, direction}. */
  rayAt(x, y) {
    const frame = this.canvas.getBoundingClientRect();
    const at = new THREE.Vector3(2 * (x - frame.left) / frame.width - 1, 1 - 2 * (y - frame.top) / frame.height, 0.5);
    const origin = this.toMap(this.camera.position);
    return { origin, direction: this.toMap(at.unproject(this.camera)).sub(origin).normalize() };
  }

  /** Where a point of the view frame is in the canvas, in pixels; undefined behind the camera. */
  onScreen(point) {
    const at = point.clone().project(this.camera);
    if (at.z > 1 || at.z < -1) return undefined;
    return { x: 0.5 * (1 + at.x) * this.canvas.clientWidth, y: 0.5 * (1 - at.y) * this.canvas.clientHeight };
  }

  #share() {
    return this.fullMs < SLOW_MS ? 1 : Math.max(SLOW_MS / this.fullMs, SMALLEST_SHARE);
  }

  #draw(share) {
    const start = performance.now();
    this.camera.updateMatrixWorld();
    for (const layer of this.layers) layer.prepare(this, share);
    this.renderer.render(this.scene, this.camera);
    if (share === 1) {
      const pixel = new Uint8Array(4), gl = this.renderer.getContext();
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel); // waits until the frame is drawn
      this.fullMs = performance.now() - start;
      this.frames += 1;
    }
    this.dispatchEvent(new Event("drawn"));
  }

  fit() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    const panel = document.getElementById("panel").getBoundingClientRect();
    const beside = panel.width < 0.5 * width && panel.height > 0.2 * height ? panel.right : 0;
    const below = panel.width > 0.9 * width ? height - panel.top : 0;
    this.camera.setViewOffset(width, height, -0.5 * beside, 0.5 * below, width, height); // the middle of what is free
    this.free = { x: (width - beside) / width, y: (height - below) / height };
    this.camera.updateProjectionMatrix();
    this.changed();
  }
}
