// Keys, as in other 3D viewers: WASD and QE to fly, arrows to turn, F to frame, Home for everything, 1 3 7 for sides.

import * as THREE from "three";

const STEP = 0.012, TURN = 0.045;
const SIDES = { 1: [0, -1, 0.02], 3: [1, 0, 0.02], 7: [0, -0.0001, 1] };

export function listenToKeys(scene, actions) {
  const held = new Set();
  let running = 0;
  const forward = () => scene.controls.target.clone().sub(scene.camera.position).normalize();

  function step() {
    running = 0;
    if (!held.size) return;
    const ahead = forward(), right = ahead.clone().cross(scene.camera.up).normalize(), up = scene.camera.up;
    const move = new THREE.Vector3();
    const far = STEP * scene.size * (held.has("shift") ? 3 : 1);
    if (held.has("w")) move.addScaledVector(ahead, far);
    if (held.has("s")) move.addScaledVector(ahead, -far);
    if (held.has("d")) move.addScaledVector(right, far);
    if (held.has("a")) move.addScaledVector(right, -far);
    if (held.has("e")) move.addScaledVector(up, far);
    if (held.has("q")) move.addScaledVector(up, -far);
    scene.camera.position.add(move);
    scene.controls.target.add(move);
    const yaw = TURN * (held.has("arrowleft") - held.has("arrowright"));
    const pitch = TURN * (held.has("arrowup") - held.has("arrowdown"));
    if (yaw || pitch) {
      const looked = scene.controls.target.clone().sub(scene.camera.position).applyAxisAngle(up, yaw);
      const tilted = looked.clone().applyAxisAngle(right, pitch);
      if (Math.abs(tilted.clone().normalize().dot(up)) < 0.99) looked.copy(tilted);
      scene.controls.target.copy(scene.camera.position).add(looked);
    }
    scene.controls.update();
    scene.moved();
    running = requestAnimationFrame(step);
  }

  addEventListener("keydown", (event) => {
    if (event.target.matches("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) {
      if (event.key === "Escape") event.target.blur();
      return;
    }
    const key = event.key.toLowerCase();
    if ("wasdqe".includes(key) || key.startsWith("arrow")) {
      held.add(key);
      if (event.shiftKey) held.add("shift");
      event.preventDefault();
      running ||= requestAnimationFrame(step);
    } else if (SIDES[key]) scene.overview(new THREE.Vector3(...SIDES[key]));
    else if (key === "home") scene.overview();
    else if (actions[key]) {
      event.preventDefault();
      actions[key]();
    }
  });
  addEventListener("keyup", (event) => {
    held.delete(event.key.toLowerCase());
    if (event.key === "Shift") held.delete("shift");
  });
  addEventListener("blur", () => held.clear());
}
