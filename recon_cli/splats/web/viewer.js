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
// How far a window may show left, right, up and down from the middle of a view's picture, whose
// borders are at 1, where nothing else is known.
const MARGINS = [1.1, 1.1, 1.1, 1.1];
const WAIT = 1.5; // seconds from the first picture to the tour
const HIDE = 3; // seconds without a sign of the visitor, until a tour shows no buttons
const CURTAIN = 0.5; // seconds that the curtain takes to close (page.html)
const SPEEDS = [1, 2, 0.5];
const PLAY = "M7 4v16l13-8z", PAUSE = "M8 5v14M16 5v14";

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
const body = document.body.classList;
let flying = false;
let needed = true; // a frame has to be drawn
let loaded = false;
let shown = 1; // number of the view that was asked for last
let lens = null; // { fx, fy, cx, cy, width, height } of what is shown
let margins = MARGINS; // how far views have seen around it
let distance = SIZE; // to what the orbit turns about
let drawn = 0; // frames
const waiting = [];

// A place as three.js needs it, from `pose`: camera to world, 12 numbers in rows, in the scene's
// axes with x right, y down, z forward; `distance` is to what the orbit turns about.
function place(view) {
  const position = new THREE.Vector3(), rotation = new THREE.Quaternion();
  new THREE.Matrix4().set(...view.pose, 0, 0, 0, 1)
    .multiply(new THREE.Matrix4().makeScale(1, -1, -1)).premultiply(world.matrixWorld)
    .decompose(position, rotation, new THREE.Vector3());
  return { position, rotation, distance: view.distance * unit,
    margins: view.margins || MARGINS, lens: scene.lenses[view.lens] };
}

function stand(at) {
  camera.position.copy(at.position);
  camera.quaternion.copy(at.rotation);
  ({ distance, margins, lens } = at);
  aim();
  project();
}

// Puts the middle of the orbit straight ahead.
function aim() {
  camera.getWorldDirection(orbit.target).multiplyScalar(distance).add(camera.position);
}

function resize() {
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, MOST_PIXELS));
  renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
  project();
}

// Gives the window the view's lens. A window of other proportions lies halfway between one that
// shows the whole picture and one that the picture fills, but shows no more beside the picture than
// other views have seen there.
function project() {
  const { clientWidth: width, clientHeight: height } = canvas;
  const fit = Math.min( // pixels of the view in one of ours
    Math.sqrt(lens.width / width * lens.height / height),
    (margins[0] + margins[1]) / 2 * lens.width / width,
    (margins[2] + margins[3]) / 2 * lens.height / height);
  const across = width * fit, down = height * fit;
  // the border of the window in the picture, from its left or upper one
  const begin = (size, part, before, after) => Math.max(
    Math.min((size - part) / 2, (1 + after) / 2 * size - part), (1 - before) / 2 * size);
  const left = begin(lens.width, across, margins[0], margins[1]) - lens.cx;
  const top = lens.cy - begin(lens.height, down, margins[2], margins[3]);
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
  pause();
  const count = scene.views.length;
  shown = ((number - 1) % count + count) % count + 1;
  for (const glide of [fly.rotateVelocity, fly.moveVelocity]) glide.set(0, 0, 0);
  stand(place(scene.views[shown - 1]));
  button("number").textContent = `${shown}/${count}`;
}

function setFlying(value) {
  flying = value;
  orbit.enabled = !flying;
  fly.enable = flying;
  fly.scroll.set(0, 0, 0); // it counts the wheel while it is switched off, too
  if (!flying) aim();
  button("mode").setAttribute("aria-pressed", String(flying));
}

// The tour: `scene.tour` lists views at equal times, which a spline joins. It begins at the view
// numbered `start`, so that the page opens on a good one, and begins again behind a curtain.
const stops = scene.tour ? scene.tour.views.map(place) : [];
const length = scene.tour ? scene.tour.seconds : 0;
let playing = false;
let time = stops.length ? length * scene.tour.start / (stops.length - 1) : 0;
let speed = 1;
let closing = 0; // seconds until the curtain is closed; 0: it is open
let seen = 0; // when there was a sign of the visitor

// The place of the tour at a time in seconds.
function along(seconds) {
  const at = Math.min(Math.max(seconds / length, 0), 1) * (stops.length - 1);
  const i = Math.min(Math.floor(at), stops.length - 2), t = at - i;
  const [p, a, b, n] = [i - 1, i, i + 1, i + 2].map(
    (k) => stops[Math.min(Math.max(k, 0), stops.length - 1)]);
  const mix = (one, other) => one + (other - one) * t;
  const curve = (axis) => { // of Catmull and Rom
    const [w, x, y, z] = [p, a, b, n].map((stop) => stop.position[axis]);
    return x + t / 2 * (y - w + t * (2 * w - 5 * x + 4 * y - z + t * (3 * (x - y) + z - w)));
  };
  return {
    position: new THREE.Vector3(curve("x"), curve("y"), curve("z")),
    rotation: a.rotation.clone().slerp(b.rotation, t), distance: mix(a.distance, b.distance),
    margins: a.margins.map((_, k) => mix(a.margins[k], b.margins[k])),
    lens: (t < 0.5 ? a : b).lens };
}

function setPlaying(value) {
  playing = value;
  seen = performance.now();
  if (!playing) {
    closing = 0;
    body.remove("closed", "quiet");
  }
  button("play").setAttribute("aria-pressed", String(playing));
  button("play").querySelector("path").setAttribute("d", playing ? PAUSE : PLAY);
  needed = true;
}

const pause = () => { if (playing) setPlaying(false); };

function play() {
  if (!stops.length) return;
  if (time >= length) time = 0;
  if (flying) setFlying(false);
  setPlaying(true);
}

function tour(seconds) {
  if (closing > 0) {
    closing -= seconds;
    if (closing > 0) return;
    time = 0;
    body.remove("closed");
  }
  time = Math.min(time + speed * seconds, length);
  stand(along(time));
  if (time === length) {
    closing = CURTAIN;
    body.add("closed");
  }
  body.toggle("quiet", performance.now() - seen > 1000 * HIDE);
}

function followHash() {
  const found = /^#view=(\d+)$/.exec(window.location.hash);
  if (found) show(Number(found[1]));
  return Boolean(found);
}

// The view that the page opens with, and the tour goes on from.
function reset() {
  pause();
  if (!stops.length) {
    show(1);
    return;
  }
  time = length * scene.tour.start / (stops.length - 1);
  stand(along(time));
  button("number").textContent = "";
}

function toggleFull() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen();
}

function ask() {
  const hidden = button("help").toggleAttribute("hidden");
  button("ask").setAttribute("aria-pressed", String(!hidden));
}

const actions = {
  before: () => show(shown - 1),
  after: () => show(shown + 1),
  reset,
  mode: () => { pause(); setFlying(!flying); },
  play: () => (playing ? pause() : play()),
  speed: () => {
    speed = SPEEDS[(SPEEDS.indexOf(speed) + 1) % SPEEDS.length];
    button("speed").textContent = `${speed === 0.5 ? "½" : speed}×`;
  },
  full: toggleFull,
  ask,
};
const shortcuts = {
  KeyP: "before", KeyN: "after", KeyR: "reset", KeyF: "mode", Space: "play" };
const walking = /^(Key[WASDQE]|Arrow)/;
for (const [name, act] of Object.entries(actions)) button(name).addEventListener("click", act);
document.addEventListener("keydown", (event) => {
  const plain = !event.ctrlKey && !event.metaKey && !event.altKey;
  const pressed = event.code === "Space" && event.target instanceof HTMLButtonElement;
  if (plain && event.code in shortcuts && !pressed) actions[shortcuts[event.code]]();
  if (plain && walking.test(event.code)) pause();
});
for (const name of ["pointermove", "pointerdown", "keydown", "wheel"]) {
  document.addEventListener(name, () => {
    seen = performance.now();
    body.remove("quiet");
  }, { capture: true, passive: true });
}
for (const name of ["pointerdown", "wheel"]) { // whoever takes the camera, has it
  canvas.addEventListener(name, pause, { capture: true, passive: true });
}
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
  if (playing) tour(seconds);
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
  if (still || (loaded && playing)) window.reconPage.ready();
  if (still && !playing) for (const done of waiting.splice(0)) done();
  requestAnimationFrame(tick);
}

// For scripts: recon.show(3) is the third view, recon.settled() a promise that is kept when the
// frame shows all Gaussians in the right order and ends the tour, recon.drawn() how many frames
// there were, recon.degreesDown() the vertical field of view; recon.tour() plays the tour, and recon.tour(12.5) shows it at that time in seconds.
window.recon = {
  views: scene.views.length,
  show,
  drawn: () => drawn,
  degreesDown: () => camera.fov,
  tour: (seconds) => {
    if (seconds === undefined) play();
    else { pause(); time = seconds; stand(along(time)); }
  },
  settled: () => new Promise((done) => { pause(); needed = true; waiting.push(done); }),
};
body.toggle("posed", scene.views.length > 1);
body.toggle("toured", stops.length > 0);
body.toggle("fullable", Boolean(document.fullscreenEnabled));
setFlying(false);
lens = scene.lenses[0];
resize();
const asked = followHash();
if (!asked) reset();
requestAnimationFrame(tick);
// Levels of detail are made in a worker, from Gaussians in which Spark has rounded the harmonics.
const mesh = new SplatMesh({ fileBytes: bytes, fileType: "spz", extSplats: true, lod: scene.lod });
await mesh.initialized;
if (!scene.lod) await restoreHarmonics(bytes, mesh.extSplats.extra);
mesh.quaternion.set(1, 0, 0, 0); // y and z of an SPZ file are those of the scene, negated
mesh.scale.setScalar(2 ** halvings);
world.add(mesh);
loaded = needed = true;
// Nobody asked for motion who asked for less of it, and without a graphics card it would stutter.
const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
if (!asked && !still && !drawsOnCpu()) {
  const untouched = seen;
  setTimeout(() => { if (seen === untouched) play(); }, 1000 * WAIT);
}
