// Gaussians as splats: each is an ellipse on the screen, drawn back to front (Kerbl et al., SIGGRAPH 2023; the projection
// of a covariance is that of Zwicker et al., EWA volume splatting, 2001).

import * as THREE from "three";

const TEXELS = 3, PER_ROW = 1024, BUCKETS = 1 << 16;

const VERTEX = `
precision highp float;
precision highp sampler2D;
uniform mat4 modelMatrix, modelViewMatrix, projectionMatrix;
uniform sampler2D splats;
uniform vec2 viewport;
uniform float cut;
in vec3 position;
in uint splat;
out vec4 color;
out vec2 at;
vec4 texel(int k) {
  int row = int(splat);
  return texelFetch(splats, ivec2((row % ${PER_ROW}) * ${TEXELS} + k, row / ${PER_ROW}), 0);
}
void main() {
  vec4 a = texel(0), b = texel(1), c = texel(2);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  at = position.xy;
  color = vec4(0.0);
  vec4 view = modelViewMatrix * vec4(a.xyz, 1.0);
  vec4 clip = projectionMatrix * view;
  if (clip.w <= 0.0 || abs(clip.z) > clip.w || (modelMatrix * vec4(a.xyz, 1.0)).z > cut) return;
  mat3 world = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
  vec2 focal = 0.5 * viewport * vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
  vec2 bounded = clamp(view.xy / -view.z, -1.3 * viewport / (2.0 * focal), 1.3 * viewport / (2.0 * focal));
  mat3 J = mat3(focal.x / -view.z, 0.0, 0.0, 0.0, focal.y / -view.z, 0.0,
                focal.x * bounded.x / -view.z, focal.y * bounded.y / -view.z, 0.0);
  mat3 M = J * mat3(modelViewMatrix);
  mat3 cov = M * world * transpose(M);
  float p = cov[0][0] + 0.3, q = cov[0][1], r = cov[1][1] + 0.3;
  float middle = 0.5 * (p + r), spread = length(vec2(0.5 * (p - r), q));
  float long2 = middle + spread, short2 = max(middle - spread, 0.1);
  vec2 axis = abs(q) < 1e-9 ? (p >= r ? vec2(1.0, 0.0) : vec2(0.0, 1.0)) : normalize(vec2(q, long2 - p));
  vec2 offset = position.x * min(sqrt(8.0 * long2), 1024.0) * axis
              + position.y * min(sqrt(8.0 * short2), 1024.0) * vec2(-axis.y, axis.x);
  gl_Position = vec4(clip.xy + 2.0 * offset / viewport * clip.w, clip.zw);
  float packed = c.z;
  color = vec4(mod(packed, 256.0), mod(floor(packed / 256.0), 256.0), floor(packed / 65536.0), 255.0 * a.w) / 255.0;
}`;

const FRAGMENT = `
precision highp float;
in vec4 color;
in vec2 at;
out vec4 pixel;
void main() {
  float r2 = dot(at, at);
  if (r2 > 1.0) discard;
  pixel = vec4(color.rgb, color.a * exp(-4.0 * r2));
}`;

export class Splats {
  /** @param arrays means (N, 3), scales (N, 3), quats_wxyz (N, 4), opacities (N,), splat_colors (N, 3). */
  constructor({ means, scales, quats_wxyz: quats, opacities, splat_colors: colors }) {
    this.count = opacities.length;
    this.means = means;
    const rows = Math.max(Math.ceil(this.count / PER_ROW), 1);
    const data = new Float32Array(4 * TEXELS * PER_ROW * rows);
    for (let n = 0; n < this.count; n += 1) this.#pack(data, n, means, scales, quats, opacities, colors);
    const texture = new THREE.DataTexture(data, TEXELS * PER_ROW, rows, THREE.RGBAFormat, THREE.FloatType);
    texture.needsUpdate = true;
    const geometry = new THREE.InstancedBufferGeometry();
    const corners = new Float32Array([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]);
    geometry.setAttribute("position", new THREE.BufferAttribute(corners, 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    this.sorted = new THREE.InstancedBufferAttribute(Uint32Array.from({ length: this.count }, (_, n) => n), 1);
    this.sorted.setUsage(THREE.DynamicDrawUsage);
    geometry.setAttribute("splat", this.sorted);
    geometry.instanceCount = this.count;
    const material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, side: THREE.DoubleSide,
      transparent: true, depthWrite: false,
      uniforms: { splats: { value: texture }, viewport: { value: new THREE.Vector2() }, cut: { value: Infinity } },
    });
    this.mesh = new THREE.Mesh(geometry, material);
    this.mesh.frustumCulled = false;
    this.mesh.renderOrder = 1;
    this.mesh.visible = false;
    this.along = new THREE.Vector3();
    this.from = new THREE.Vector3(Infinity, 0, 0);
    this.depths = new Float32Array(this.count);
  }

  set cut(height) {
    this.mesh.material.uniforms.cut.value = Math.min(height, 3e38);
  }

  prepare(scene, share) {
    if (!this.mesh.visible) return;
    scene.renderer.getDrawingBufferSize(this.mesh.material.uniforms.viewport.value);
    this.mesh.geometry.instanceCount = this.count;
    const origin = scene.toMap(scene.camera.position);
    const along = scene.toMap(scene.camera.localToWorld(new THREE.Vector3(0, 0, -1))).sub(origin).normalize();
    const turned = along.dot(this.along) < (share < 1 ? 0.95 : 0.999);
    if (turned || origin.distanceTo(this.from) > (share < 1 ? 0.1 : 0.02) * scene.size) this.#sort(origin, along);
  }

  dispose() {
    this.mesh.material.uniforms.splats.value.dispose();
    this.mesh.geometry.dispose();
    this.mesh.material.dispose();
    this.mesh.removeFromParent();
  }

  /** Texels: (mean, opacity), (S00 S01 S02 S11), (S12 S22 color -) with S = R diag(s^2) R^T. */
  #pack(data, n, means, scales, quats, opacities, colors) {
    let [w, x, y, z] = [0, 1, 2, 3].map((k) => quats[4 * n + k] / 127);
    const length = Math.hypot(w, x, y, z) || 1;
    [w, x, y, z] = [w / length, x / length, y / length, z / length];
    const R = [
      1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ];
    const s = [0, 1, 2].map((k) => scales[3 * n + k] ** 2);
    const S = (i, j) => R[3 * i] * R[3 * j] * s[0] + R[3 * i + 1] * R[3 * j + 1] * s[1] + R[3 * i + 2] * R[3 * j + 2] * s[2];
    const at = 4 * TEXELS * (PER_ROW * Math.floor(n / PER_ROW) + (n % PER_ROW));
    data.set([means[3 * n], means[3 * n + 1], means[3 * n + 2], opacities[n] / 255], at);
    data.set([S(0, 0), S(0, 1), S(0, 2), S(1, 1)], at + 4);
    data.set([S(1, 2), S(2, 2), colors[3 * n] + 256 * colors[3 * n + 1] + 65536 * colors[3 * n + 2], 0], at + 8);
  }

  /** Orders the splats from far to near by counting. */
  #sort(origin, along) {
    const { means, depths, count } = this;
    let low = Infinity, high = -Infinity;
    for (let n = 0; n < count; n += 1) {
      const depth = (means[3 * n] - origin.x) * along.x + (means[3 * n + 1] - origin.y) * along.y
        + (means[3 * n + 2] - origin.z) * along.z;
      depths[n] = depth;
      if (depth < low) low = depth;
      if (depth > high) high = depth;
    }
    const scale = (BUCKETS - 1) / Math.max(high - low, 1e-9), starts = new Uint32Array(BUCKETS + 1);
    for (let n = 0; n < count; n += 1) starts[1 + Math.floor((high - depths[n]) * scale)] += 1;
    for (let k = 0; k < BUCKETS; k += 1) starts[k + 1] += starts[k];
    for (let n = 0; n < count; n += 1) this.sorted.array[starts[Math.floor((high - depths[n]) * scale)]++] = n;
    this.sorted.needsUpdate = true;
    this.along.copy(along);
    this.from.copy(origin);
  }
}
