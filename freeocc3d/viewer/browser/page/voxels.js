// Voxels as instanced cubes, of which three faces are drawn: no more can be seen. Of a large map, what is out of view is
// left out, and what is smaller than a few pixels is a point with the mean shade of these faces.

import * as THREE from "three";

const VERTEX = `
precision highp float;
uniform mat4 modelMatrix, modelViewMatrix, projectionMatrix;
uniform vec3 eye, origin;
uniform float unit, cut, inset;
in vec3 position, face;
in vec4 voxel, color;
out vec4 shade;
out vec2 corner;
void main() {
  vec3 center = origin + unit * (voxel.xyz + 0.5 * voxel.w);
  vec3 side = vec3(greaterThanEqual(eye, center)) * 2.0 - 1.0;
  float height = (modelMatrix * vec4(center, 1.0)).z;
  vec3 at = center + 0.5 * inset * unit * voxel.w * position * side;
  gl_Position = color.a == 0.0 || height > cut ? vec4(2.0, 2.0, 2.0, 1.0)
    : projectionMatrix * modelViewMatrix * vec4(at, 1.0);
  vec3 normal = mat3(modelMatrix) * (face * side);
  shade = vec4(color.rgb * (0.86 + 0.14 * normal.z + 0.07 * normal.x - 0.05 * normal.y), color.a);
  corner = face.x > 0.5 ? position.yz : face.y > 0.5 ? position.zx : position.xy;
}`;

const FRAGMENT = `
precision highp float;
uniform float opacity;
in vec4 shade;
in vec2 corner;
out vec4 pixel;
void main() {
  vec2 width = fwidth(corner);
  vec2 border = (1.0 - abs(corner)) / max(width, 1e-6);
  float near = (1.0 - smoothstep(0.4, 1.4, min(border.x, border.y))) * (1.0 - smoothstep(0.1, 0.3, max(width.x, width.y)));
  pixel = vec4(shade.rgb * (1.0 - 0.22 * near), opacity);
}`;

const POINT_VERTEX = `
precision highp float;
uniform mat4 modelMatrix, modelViewMatrix, projectionMatrix;
uniform vec3 eye, origin;
uniform float unit, cut, pixels;
in vec4 voxel, color;
flat out vec4 shade;
void main() {
  vec3 center = origin + unit * (voxel.xyz + 0.5 * voxel.w);
  vec3 towards = normalize(eye - center);
  float height = (modelMatrix * vec4(center, 1.0)).z;
  gl_Position = color.a == 0.0 || height > cut ? vec4(2.0, 2.0, 2.0, 1.0)
    : projectionMatrix * modelViewMatrix * vec4(center, 1.0);
  vec3 faces = abs(towards), normal = mat3(modelMatrix) * (faces * sign(towards));
  float area = faces.x + faces.y + faces.z;
  shade = vec4(color.rgb * (0.86 + (0.14 * normal.z + 0.07 * normal.x - 0.05 * normal.y) / area), color.a);
  gl_PointSize = max(pixels * unit * voxel.w * sqrt(area) / max(gl_Position.w, 1e-6), 1.0);
}`;

const POINT_FRAGMENT = `
precision mediump float;
uniform float opacity;
flat in vec4 shade;
out vec4 pixel;
void main() { pixel = vec4(shade.rgb, opacity); }`;

const ALL_CUBES = 150000, POINT_PX = 3.5;

/** The three faces of a cube of edge 2 that look along the axes. */
function threeFaces() {
  const positions = [], faces = [], indices = [];
  for (let axis = 0; axis < 3; axis += 1) {
    const [u, v] = [(axis + 1) % 3, (axis + 2) % 3], first = positions.length / 3;
    for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
      const corner = [0, 0, 0], face = [0, 0, 0];
      corner[axis] = face[axis] = 1;
      corner[u] = a;
      corner[v] = b;
      positions.push(...corner);
      faces.push(...face);
    }
    indices.push(first, first + 1, first + 2, first, first + 2, first + 3);
  }
  return { positions: new Float32Array(positions), faces: new Float32Array(faces), indices };
}

/** A random order, always the same: any first part of it is spread over the whole map. */
function shuffled(count) {
  const order = Uint32Array.from({ length: count }, (_, row) => row);
  let state = 12345;
  for (let last = count - 1; last > 0; last -= 1) {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
    const other = Math.floor((state / 4294967296) * (last + 1));
    [order[last], order[other]] = [order[other], order[last]];
  }
  return order;
}

export class Voxels {
  /**
   * @param voxels (V, 4) int16: corner and edge, in units.  @param lattice {origin, unit}, map frame.
   * @param look {opacity, inset}: inset is the share of the edge that is drawn.
   */
  constructor(voxels, lattice, look = { opacity: 1, inset: 1 }) {
    this.voxels = voxels;
    this.lattice = lattice;
    this.count = voxels.length / 4;
    this.order = shuffled(this.count);
    this.colors = new Uint8Array(4 * this.count); // in row order; alpha 0 hides a voxel
    this.drawn = new Int16Array(4 * this.count); // in the order of drawing
    this.order.forEach((row, at) => this.drawn.set(voxels.subarray(4 * row, 4 * row + 4), 4 * at));
    this.drawnColors = new Uint8Array(4 * this.count);
    this.divided = this.count > ALL_CUBES;
    const uniforms = {
      eye: { value: new THREE.Vector3() }, origin: { value: new THREE.Vector3(...lattice.origin) },
      unit: { value: lattice.unit }, cut: { value: Infinity }, inset: { value: look.inset },
      opacity: { value: look.opacity }, pixels: { value: 1 },
    };
    this.uniforms = uniforms;
    this.mesh = new THREE.Group();
    this.cubes = this.#makeCubes(look, uniforms);
    this.mesh.add(this.cubes);
    if (this.divided) {
      this.points = this.#makePoints(look, uniforms);
      this.mesh.add(this.points);
    }
  }

  #makeCubes(look, uniforms) {
    const cube = threeFaces(), geometry = new THREE.InstancedBufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(cube.positions, 3));
    geometry.setAttribute("face", new THREE.BufferAttribute(cube.faces, 3));
    geometry.setIndex(cube.indices);
    const copied = (array) => (this.divided ? array.slice() : array);
    geometry.setAttribute("voxel", new THREE.InstancedBufferAttribute(copied(this.drawn), 4));
    geometry.setAttribute("color", new THREE.InstancedBufferAttribute(copied(this.drawnColors), 4, true));
    for (const name of ["voxel", "color"]) geometry.attributes[name].setUsage(THREE.DynamicDrawUsage);
    geometry.instanceCount = this.count;
    const mesh = new THREE.Mesh(geometry, new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, side: THREE.DoubleSide,
      transparent: look.opacity < 1, depthWrite: look.opacity === 1, uniforms,
    }));
    mesh.frustumCulled = false;
    return mesh;
  }

  #makePoints(look, uniforms) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("voxel", new THREE.BufferAttribute(this.drawn, 4));
    geometry.setAttribute("color", new THREE.BufferAttribute(this.drawnColors, 4, true));
    geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(this.count), 1));
    geometry.index.setUsage(THREE.DynamicDrawUsage);
    const points = new THREE.Points(geometry, new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader: POINT_VERTEX, fragmentShader: POINT_FRAGMENT,
      transparent: look.opacity < 1, depthWrite: look.opacity === 1, uniforms,
    }));
    points.frustumCulled = false;
    return points;
  }

  set cut(height) {
    this.uniforms.cut.value = Math.min(height, 3e38);
  }

  get cut() {
    return this.uniforms.cut.value;
  }

  /** Called before each frame. */
  prepare(scene, share) {
    if (!this.mesh.visible) return;
    this.uniforms.eye.value.copy(scene.toMap(scene.camera.position));
    const shown = Math.ceil(share * this.count);
    if (this.divided) this.#divide(scene, shown);
    else this.cubes.geometry.instanceCount = shown;
  }

  /** Draws with the colors that stand in ``colors``. */
  recolor() {
    const from = new Uint32Array(this.colors.buffer), to = new Uint32Array(this.drawnColors.buffer);
    for (let at = 0; at < this.count; at += 1) to[at] = from[this.order[at]];
    (this.points ?? this.cubes).geometry.attributes.color.needsUpdate = true;
  }

  /** Puts the first ``shown`` voxels that are in view among the cubes, or among the points if they are small. */
  #divide(scene, shown) {
    const { camera, canvas } = scene, { origin, unit } = this.lattice, { drawn } = this;
    const pixels = 0.5 * canvas.height * camera.projectionMatrix.elements[5];
    this.uniforms.pixels.value = pixels;
    const M = new THREE.Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse)
      .multiply(scene.world.matrixWorld).elements;
    const at = [0, 1, 3].map((k) => M[k] * origin[0] + M[k + 4] * origin[1] + M[k + 8] * origin[2] + M[k + 12]);
    const [mx, my, mw] = [0, 1, 3].map((k) => [M[k] * unit, M[k + 4] * unit, M[k + 8] * unit]);
    const { voxel, color } = this.cubes.geometry.attributes, { index } = this.points.geometry;
    const colors = new Uint32Array(this.drawnColors.buffer), cubeColors = new Uint32Array(color.array.buffer);
    let cubes = 0, points = 0;
    for (let n = 0, m = 0; n < shown; n += 1, m += 4) {
      const edge = drawn[m + 3], half = 0.5 * edge, x = drawn[m] + half, y = drawn[m + 1] + half, z = drawn[m + 2] + half;
      const w = mw[0] * x + mw[1] * y + mw[2] * z + at[2], reach = edge * unit, size = pixels * reach;
      if (w < -reach) continue;
      const bound = w + 2 * reach;
      if (Math.abs(mx[0] * x + mx[1] * y + mx[2] * z + at[0]) > bound) continue;
      if (Math.abs(my[0] * x + my[1] * y + my[2] * z + at[1]) > bound) continue;
      if (size < POINT_PX * w) index.array[points++] = n;
      else {
        voxel.array[4 * cubes] = drawn[m];
        voxel.array[4 * cubes + 1] = drawn[m + 1];
        voxel.array[4 * cubes + 2] = drawn[m + 2];
        voxel.array[4 * cubes + 3] = edge;
        cubeColors[cubes++] = colors[n];
      }
    }
    this.cubes.geometry.instanceCount = cubes;
    this.points.geometry.setDrawRange(0, points);
    for (const [attribute, used] of [[voxel, 4 * cubes], [color, 4 * cubes], [index, points]]) {
      attribute.clearUpdateRanges();
      attribute.addUpdateRange(0, used);
      attribute.needsUpdate = used > 0;
    }
  }

  center(row) {
    const { origin, unit } = this.lattice, at = 4 * row, half = 0.5 * this.voxels[at + 3];
    return [0, 1, 2].map((axis) => origin[axis] + (this.voxels[at + axis] + half) * unit);
  }

  /** The first shown voxel along a ray of the map's frame: {row, distance}; undefined if there is none. */
  pick({ origin, direction }, T_view_map) {
    const { origin: corner, unit } = this.lattice, { voxels, colors, cut } = this;
    const from = ["x", "y", "z"].map((axis, k) => (origin[axis] - corner[k]) / unit);
    const inverse = ["x", "y", "z"].map((axis) => 1 / (direction[axis] || 1e-12));
    const up = [2, 6, 10].map((k) => T_view_map.elements[k] * unit);
    const base = T_view_map.elements[2] * corner[0] + T_view_map.elements[6] * corner[1] + T_view_map.elements[10] * corner[2]
      + T_view_map.elements[14];
    let best = Infinity, found = -1;
    for (let row = 0, at = 0; row < this.count; row += 1, at += 4) {
      const edge = voxels[at + 3], half = 0.5 * edge;
      const x = voxels[at], y = voxels[at + 1], z = voxels[at + 2];
      const ax = (x - from[0]) * inverse[0], bx = (x + edge - from[0]) * inverse[0];
      const ay = (y - from[1]) * inverse[1], by = (y + edge - from[1]) * inverse[1];
      const az = (z - from[2]) * inverse[2], bz = (z + edge - from[2]) * inverse[2];
      const enter = Math.max(Math.min(ax, bx), Math.min(ay, by), Math.min(az, bz));
      const leave = Math.min(Math.max(ax, bx), Math.max(ay, by), Math.max(az, bz));
      if (enter > leave || enter <= 0 || enter >= best || colors[at + 3] === 0) continue;
      if (base + up[0] * (x + half) + up[1] * (y + half) + up[2] * (z + half) > cut) continue;
      best = enter;
      found = row;
    }
    return found < 0 ? undefined : { row: found, distance: best * unit };
  }

  dispose() {
    for (const each of this.mesh.children) {
      each.geometry.dispose();
      each.material.dispose();
    }
    this.mesh.removeFromParent();
  }
}
