// The page's own part: decodes the scene, holds the camera, draws when something changed.
//
// The world of three.js has y up; the group `world` turns the scene's up there and makes the scene
// `SIZE` units large, because Spark sorts again only after a camera has moved by 0.001 units.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { FpsMovement, PointerControls, SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { restoreHarmonics } from "harmonics";

const SIZE = 5; // units from the middle of the scene to where most of it ends
const NEAR = 0.05; // scene units, where recon's renderer begins to draw; less in a tiny scene:
const NEAR_SHARE = 0.02; // of how far the scene reaches
const FAR = 1e4; // units of three.js
const DILATION = 0.3; // pixels squared, which recon adds to the covariance of a projected Gaussian
const CUTOFF = 2 * Math.log(255); // squared deviations at which an opaque Gaussian falls to 1/255
// Gaussians of a frame where the scene has levels of detail and the browser draws on the CPU; for a
// graphics card Spark chooses.
const FEW = 200_000;
// Times the window beyond which a Gaussian is left out by its middle: none is. Spark's 1.4 leaves out
// large ones that show in the window.
const CLIP = 1e6;
// Times the window within which slopes are held in the projection of a Gaussian, as in training:
// Spark, which leaves out what is beside the window, holds none, and makes a fog of it.
const HELD = 1.3;
const SPARK_SLOPES = "vec2 J2 = -(J1 * viewCenter.xy) * invZ;";
const HELD_SLOPES = `
  vec2 shift = vec2(projectionMatrix[2][0], projectionMatrix[2][1]);
  vec2 lens = vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
  vec2 J2 = -J1 * clamp(viewCenter.xy * invZ,
                        (-${HELD} - shift) / lens, (${HELD} - shift) / lens);`;
const MOST_PIXELS = 2; // device pixels a CSS pixel; more cost time and show nothing

const { bytes, halvings, scene } = window.reconPage; // the scene is halved to fit into .spz
const canvas = document.querySelector("canvas");
const button = (name) => document.getElementById(name);

const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });

// Whether the browser draws on the CPU.
function drawsOnCpu() {
  const gl = renderer.getContext();
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

renderer.setClearColor(0x000000, 1);
const spark = new SparkRenderer({
  renderer,
  onDirty: () => { needed = true; },
  preBlurAmount: DILATION, // the scene was trained without compensation of its opacities
  blurAmount: 0,
  sortRadial: false, // by depth, as it was trained
  accumExtSplats: true, // positions of 32 bits; those of 16 can be seen
  clipXY: CLIP,
  maxStdDev: Math.sqrt(CUTOFF),
  minAlpha: 1 / 255,
  maxPixelRadius: 1e7,
  enableLod: scene.lod,
  lodSplatCount: drawsOnCpu() ? FEW : undefined,
});
if (!spark.material.vertexShader.includes(SPARK_SLOPES)) throw new Error("another Spark");
spark.material.vertexShader = spark.material.vertexShader.replace(SPARK_SLOPES, HELD_SLOPES);
const camera = new THREE.PerspectiveCamera();
const world = new THREE.Group();
const root = new THREE.Scene();
root.add(spark, world);

const unit = SIZE / scene.reach;
world.quaternion.setFromUnitVectors(new THREE.Vector3(...scene.up), new THREE.Vector3(0, 1, 0));
world.scale.setScalar(unit);
world.position.set(...scene.middle).applyQuaternion(world.quaternion).multiplyScalar(-unit);
world.updateMatrixWorld();

const orbit = new OrbitControls(camera, canvas);
const fly = new PointerControls({ canvas });
const keys = new FpsMovement();
let flying = false;
let needed = true; // a frame has to be drawn
let loaded = false;
let shown = 1; // number of the view that was asked for last
let lens = null; // { fx, fy, cx, cy, width, height } of that view
let distance = SIZE; // to what the orbit turns about
let drawn = 0; // frames
const waiting = [];

// Takes the place and the lens of a view: `pose` is camera to world, 12 numbers in rows, in the
// scene's axes with x right, y down, z forward; `distance` is to what the orbit turns about.
function look(view, given) {
  const turned = new THREE.Matrix4().set(...view.pose, 0, 0, 0, 1)
    .multiply(new THREE.Matrix4().makeScale(1, -1, -1)).premultiply(world.matrixWorld);
  turned.decompose(camera.position, camera.quaternion, new THREE.Vector3());
  for (const glide of [fly.rotateVelocity, fly.moveVelocity]) glide.set(0, 0, 0);
  lens = given;
  distance = view.distance * unit;
  aim();
  resize();
}

// Puts the middle of the orbit straight ahead.
function aim() {
  camera.getWorldDirection(orbit.target).multiplyScalar(distance).add(camera.position);
}

// Gives the window the view's lens. A window of other proportions lies halfway between one that
// shows the whole picture and one that the picture fills.
function resize() {
  const { clientWidth: width, clientHeight: height } = canvas;
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, MOST_PIXELS));
  renderer.setSize(width, height, false);
  const fit = Math.sqrt(lens.width / width * lens.height / height); // its pixels in one of ours
  const across = width * fit, down = height * fit;
  const left = (lens.width - across) / 2 - lens.cx, top = lens.cy - (lens.height - down) / 2;
  const near = Math.min(NEAR, NEAR_SHARE * scene.reach) * unit;
  camera.near = near;
  camera.far = FAR;
  camera.aspect = width / height;
  camera.fov = 2 * THREE.MathUtils.radToDeg(Math.atan(down / 2 / lens.fy)); // for the controls
  camera.projectionMatrix.makePerspective(
    left / lens.fx * near, (left + across) / lens.fx * near,
    top / lens.fy * near, (top - down) / lens.fy * near, near, FAR);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  needed = true;
}

function show(number) {
  const count = scene.views.length;
  shown = ((number - 1) % count + count) % count + 1;
  const view = scene.views[shown - 1];
  look(view, scene.lenses[view.lens]);
  button("name").textContent = `${shown}/${count} ${view.name}`;
}

function setFlying(value) {
  flying = value;
  orbit.enabled = !flying;
  fly.enable = flying;
  fly.scroll.set(0, 0, 0); // it counts the wheel while it is switched off, too
  if (!flying) aim();
  button("mode").textContent = flying ? "orbit" : "fly";
  button("mode").setAttribute("aria-pressed", String(flying));
}

function followHash() {
  const found = /^#view=(\d+)$/.exec(window.location.hash);
  if (found) show(Number(found[1]));
}

const actions = {
  before: () => show(shown - 1),
  after: () => show(shown + 1),
  reset: () => show(1),
  mode: () => setFlying(!flying),
};
const shortcuts = { KeyP: "before", KeyN: "after", KeyR: "reset", KeyF: "mode" };
for (const [name, act] of Object.entries(actions)) button(name).addEventListener("click", act);
document.addEventListener("keydown", (event) => {
  const plain = !event.ctrlKey && !event.metaKey && !event.altKey;
  if (plain && event.code in shortcuts) actions[shortcuts[event.code]]();
});
window.addEventListener("hashchange", followHash);
window.addEventListener("resize", resize);
orbit.addEventListener("change", () => { needed = true; });
canvas.addEventListener("webglcontextlost", () => {
  window.reconPage.say("The browser took the graphics away. Reload the page.");
});

let last = performance.now();
function tick(now) {
  const seconds = Math.min((now - last) / 1000, 0.1);
  last = now;
  const before = camera.position.clone();
  const moved = keys.update(seconds, camera);
  orbit.target.add(camera.position).sub(before);
  const turned = flying && fly.update(Math.max(seconds, 1e-3), camera);
  if (moved || turned || needed) {
    needed = false;
    renderer.render(root, camera);
    drawn++;
  }
  const still = loaded && !needed && !spark.dirty && !spark.sorting && !spark.sortDirty;
  if (still) {
    window.reconPage.ready();
    for (const done of waiting.splice(0)) done();
  }
  requestAnimationFrame(tick);
}

// For scripts: recon.show(3) is the third view, recon.settled() a promise that is kept when the
// frame shows all Gaussians in the right order, recon.drawn() how many frames there were.
window.recon = {
  views: scene.views.map((view) => view.name),
  show,
  drawn: () => drawn,
  settled: () => new Promise((done) => { needed = true; waiting.push(done); }),
};
document.body.classList.toggle("posed", scene.views.length > 1);
setFlying(false);
show(1);
followHash();
requestAnimationFrame(tick);
// Levels of detail are made in a worker, from Gaussians in which Spark has rounded the harmonics.
const mesh = new SplatMesh({ fileBytes: bytes, fileType: "spz", extSplats: true, lod: scene.lod });
await mesh.initialized;
if (!scene.lod) await restoreHarmonics(bytes, mesh.extSplats.extra);
mesh.quaternion.set(1, 0, 0, 0); // y and z of an SPZ file are those of the scene, negated
mesh.scale.setScalar(2 ** halvings);
world.add(mesh);
loaded = needed = true;
