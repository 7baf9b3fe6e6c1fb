// The parts of three.js that the viewer uses. To renew three.min.js, in an empty folder with a copy of this file:
//   npm install three@0.187.0 esbuild
//   npx esbuild three_entry.js --bundle --minify --format=esm --legal-comments=eof --outfile=three.min.js
export {
  WebGLRenderer, Scene, PerspectiveCamera, Vector2, Vector3, Vector4, Matrix3, Matrix4, Quaternion, Color, Box3, Plane,
  Ray, BufferGeometry, InstancedBufferGeometry, BufferAttribute, InstancedBufferAttribute, Float32BufferAttribute,
  DataTexture, LineSegments, Line, Points, Mesh, Group, ShaderMaterial, RawShaderMaterial, LineBasicMaterial,
  MeshBasicMaterial, PointsMaterial, SphereGeometry, BoxGeometry, GLSL3, DoubleSide, NormalBlending,
  RGBAIntegerFormat, RedIntegerFormat, UnsignedIntType, FloatType, RGBAFormat, NearestFilter, DynamicDrawUsage,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
