// The camera path, and a small pyramid for each keyframe, which opens its photograph.

import * as THREE from "three";

const SIZE = 0.02, NEAR_PX = 12;
const COLORS = { path: 0x3b6fd8, keyframe: 0x3b6fd8, chosen: 0xe8590c };

export class CameraPath {
  /** @param arrays path (P, 3), T_map_cam (K, 16), cameras (K, 6), map frame.  @param size of the scene. */
  constructor({ path, T_map_cam: poses, cameras }, size) {
    this.count = cameras.length / 6;
    this.group = new THREE.Group();
    const way = new THREE.BufferGeometry();
    way.setAttribute("position", new THREE.BufferAttribute(path, 3));
    this.group.add(new THREE.Line(way, new THREE.LineBasicMaterial({ color: COLORS.path })));
    const corners = new Float32Array(this.count * 16 * 3), colors = new Float32Array(this.count * 16 * 3);
    this.cameras = Array.from({ length: this.count }, (_, k) => {
      const [width, height, fx, fy, cx, cy] = cameras.subarray(6 * k, 6 * k + 6);
      const T = new THREE.Matrix4().set(...poses.subarray(16 * k, 16 * k + 16));
      return { T, width, height, fx, fy, cx, cy, center: new THREE.Vector3().setFromMatrixPosition(T) };
    });
    this.cameras.forEach((camera, k) => this.#pyramid(camera, SIZE * size).forEach((point, n) => point.toArray(corners, 3 * (16 * k + n))));
    const pyramids = new THREE.BufferGeometry();
    pyramids.setAttribute("position", new THREE.BufferAttribute(corners, 3));
    pyramids.setAttribute("color", new THREE.BufferAttribute(colors, 3));
    this.pyramids = new THREE.LineSegments(pyramids, new THREE.LineBasicMaterial({ vertexColors: true }));
    this.pyramids.frustumCulled = false;
    this.group.add(this.pyramids);
    this.choose(undefined);
  }

  choose(keyframe) {
    const colors = this.pyramids.geometry.attributes.color;
    for (let k = 0; k < this.count; k += 1) {
      const color = new THREE.Color(k === keyframe ? COLORS.chosen : COLORS.keyframe);
      for (let n = 0; n < 16; n += 1) color.toArray(colors.array, 3 * (16 * k + n));
    }
    colors.needsUpdate = true;
  }

  /** The keyframe within a few pixels of a place of the canvas: {keyframe, distance}; undefined if there is none. */
  pick(scene, x, y) {
    let best;
    this.cameras.forEach(({ center }, keyframe) => {
      const point = center.clone().applyMatrix4(scene.world.matrixWorld), at = scene.onScreen(point);
      const away = at ? Math.hypot(at.x - x, at.y - y) : Infinity;
      if (away <= NEAR_PX && away < (best?.away ?? Infinity)) {
        best = { keyframe, away, distance: point.distanceTo(scene.camera.position) };
      }
    });
    return best;
  }

  /** Looks from where a keyframe was taken. */
  lookFrom(scene, keyframe) {
    const { T, center } = this.cameras[keyframe], position = center.clone().applyMatrix4(scene.world.matrixWorld);
    const ahead = new THREE.Vector3(0, 0, 0.15 * scene.size).applyMatrix4(T).applyMatrix4(scene.world.matrixWorld);
    scene.fly(position, ahead);
  }

  dispose() {
    this.group.traverse((each) => {
      each.geometry?.dispose();
      each.material?.dispose();
    });
    this.group.removeFromParent();
  }

  #pyramid({ T, width, height, fx, fy, cx, cy }, size) {
    const scale = size / Math.max(width / fx, height / fy);
    const at = (u, v) => new THREE.Vector3((u - cx) / fx, (v - cy) / fy, 1).multiplyScalar(scale).applyMatrix4(T);
    const tip = new THREE.Vector3().setFromMatrixPosition(T);
    const [a, b, c, d] = [at(0, 0), at(width, 0), at(width, height), at(0, height)];
    return [tip, a, tip, b, tip, c, tip, d, a, b, b, c, c, d, d, a];
  }
}
