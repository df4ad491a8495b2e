// What the page takes from three.js and Spark, as the one global name SPLATS.
export { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
export {
  Matrix4, PerspectiveCamera, Quaternion, Scene, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
