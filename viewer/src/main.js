/** The page of gsplat-inspect view: opens the files of its configuration and lets people look at them. */
import "./style.css";
import * as THREE from "three";
import { FlyControls } from "three/addons/controls/FlyControls.js";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { openSource } from "./sources.js";
import { describeCamera, exactCamera, Stage } from "./stage.js";

const DEFAULT_FPS = 30;
const LONGEST_STEP = 0.25; // seconds that playing skips at most, where a picture took longer
// Spark sorts after it draws and shows the order in a later picture: so long, and so often, is drawn after a change.
const [SETTLING, PICTURES_TO_SETTLE] = [500, 6];
const EMPTY_VIEW = { position: [0, 0, 3], target: [0, 0, 0] };
const element = (id) => document.getElementById(id);
const config = JSON.parse(element("config").textContent);
const canvas = element("canvas");
const stage = new Stage(canvas);
const camera = new THREE.PerspectiveCamera(50, 1, 0.01, 1000);
const orbit = Object.assign(new OrbitControls(camera, canvas), { enableDamping: false });
const state = { sources: [], t: 0, playing: false, orbit, fly: null, busy: false, fovY: 50, drawn: 0, since: performance.now() };

start();

async function start() {
  setUpCamera();
  listen();
  requestAnimationFrame(loop);
  for (const [index, file] of config.files.entries()) {
    element(`name-${index}`).textContent = file.note ? `${file.name} (${file.note})` : file.name;
    element("loading").textContent = `loading ${file.name} …`;
    try {
      if (file.error) throw new Error(file.error);
      const source = await openSource(file);
      state.sources.push({ ...source, file });
      element(`facts-${index}`).textContent = `${source.splats.toLocaleString("en")} splats · ${size(file.bytes)}`;
      if (source.player) await source.player.show(state.t, element("interpolation").value);
      stage.add(source.mesh);
    } catch (error) {
      await explain(file, error);
    }
  }
  const degree = Math.max(0, ...state.sources.map((source) => source.degree));
  element("degree").replaceChildren(...Array.from({ length: degree + 1 }, (_, d) => new Option(d, d, d === degree, d === degree)));
  element("degree-label").hidden = degree === 0;
  element("time-row").hidden = !longest();
  if (longest()) showTime();
  element("mode-label").hidden = stage.sides.length < 2;
  setMode(stage.sides.length < 2 ? "first" : "split");
  readLink();
  touch();
  window.viewer.ready = true;
}

function size(bytes) {
  const [unit, name] = [[1e9, "GB"], [1e6, "MB"], [1e3, "kB"]].find(([each]) => bytes >= each) ?? [1, "bytes"];
  return `${Number((bytes / unit).toPrecision(3))} ${name}`;
}

/** Tell what is wrong with a file, in the validator's words where the server has them. */
async function explain(file, error) {
  const reason = String(error?.message ?? error);
  let words = reason.includes(file.name) ? reason : `${file.name}: ${reason}`;
  if (file.report) {
    const found = await fetch(file.report)
      .then((response) => response.json())
      .catch(() => null);
    const issues = found?.issues ?? [];
    const lines = issues.map(({ severity, code, message }) => `${severity} ${code}: ${message}`);
    if (issues.some(({ severity }) => severity === "error")) words = `${file.name} is not valid:\n${lines.join("\n")}`;
  }
  say(element("message").hidden ? words : `${element("words").textContent}\n\n${words}`);
}

function say(text) {
  element("words").textContent = text;
  element("message").hidden = false;
}

/** The player with the most keyframes, or null where nothing moves. */
function longest() {
  const players = state.sources.map(({ player }) => player).filter((player) => player?.frameCount > 1);
  return players.reduce((found, player) => (found && found.frameCount >= player.frameCount ? found : player), null);
}

/** Have the page drawn for a while. */
function touch() {
  [state.until, state.owed] = [performance.now() + SETTLING, PICTURES_TO_SETTLE];
}

function setUpCamera(given = config.cameras[0]) {
  if (config.up) camera.up.set(...config.up);
  if (given) {
    exactCamera(given).matrix.decompose(camera.position, camera.quaternion, camera.scale);
    state.fovY = THREE.MathUtils.radToDeg(2 * Math.atan(given.height / 2 / given.K[1][1]));
    [camera.near, camera.far] = [given.near, given.far];
  } else camera.position.set(...EMPTY_VIEW.position);
  orbit.target.set(...(config.center ?? EMPTY_VIEW.target));
  orbit.update();
  fitField();
}

/** The field of view is that of the narrower side, so that what fits a wide window fits a phone. */
function fitField() {
  const half = Math.tan(THREE.MathUtils.degToRad(state.fovY) / 2) / Math.min(1, camera.aspect);
  camera.fov = THREE.MathUtils.radToDeg(2 * Math.atan(half));
  camera.updateProjectionMatrix();
}

function listen() {
  addEventListener("resize", resize);
  addEventListener("keydown", onKey);
  addEventListener("hashchange", readLink);
  element("play").onclick = () => setPlaying(!state.playing);
  element("back").onclick = () => step(-1);
  element("forward").onclick = () => step(1);
  element("time").oninput = ({ target }) => seek(Number(target.value));
  element("interpolation").onchange = () => seek(state.t);
  element("mode").onchange = ({ target }) => setMode(target.value);
  element("degree").onchange = ({ target }) => (stage.limitDegree(Number(target.value)), touch());
  element("control").onchange = ({ target }) => setControl(target.value);
  element("reset").onclick = () => setUpCamera();
  element("copy-camera").onclick = () => copy(JSON.stringify([currentCamera()], null, 1), "camera");
  element("copy-link").onclick = () => copy(writeLink(), "link");
  element("help").onclick = () => (element("keys").hidden = !element("keys").hidden);
  element("hide").onclick = () => togglePanel();
  element("close").onclick = () => (element("message").hidden = true);
  element("divider").onpointerdown = dragDivider;
  element("divider").onkeydown = moveDivider;
  // A list or a button that was used with the mouse does not keep the keys; used with the keyboard, it does.
  addEventListener("pointerdown", () => (state.byPointer = true), true);
  addEventListener("keydown", () => (state.byPointer = false), true);
  for (const type of ["click", "change"]) {
    element("panel").addEventListener(type, ({ target }) => {
      if (state.byPointer && (type === "change" || target.closest("button"))) document.activeElement?.blur();
    });
  }
  resize();
}

function onKey(event) {
  const { tagName, type } = event.target;
  if (tagName === "SELECT" || (tagName === "INPUT" && !(type === "range" && event.key === " "))) return;
  if (tagName === "BUTTON" && [" ", "Enter"].includes(event.key)) return;
  const keys = {
    " ": () => setPlaying(!state.playing),
    ",": () => step(-1),
    ".": () => step(1),
    ArrowLeft: () => seek(Math.max(0, state.t - 0.02)),
    ArrowRight: () => seek(Math.min(1, state.t + 0.02)),
    0: () => setUpCamera(),
    m: () => setMode(next(element("mode"))),
    i: () => (next(element("interpolation")), seek(state.t)),
    c: () => element("copy-camera").click(),
    l: () => element("copy-link").click(),
    h: () => element("help").click(),
    p: togglePanel,
    Escape: () => element("close").click(),
  };
  for (let k = 1; k <= Math.min(9, config.cameras.length); k++) keys[k] = () => setUpCamera(config.cameras[k - 1]);
  const action = keys[event.key] ?? keys[event.key.toLowerCase()];
  const isFlying = element("control").value === "fly";
  if (!action || event.ctrlKey || event.metaKey || event.altKey || (isFlying && "wasdqerf".includes(event.key))) return;
  event.preventDefault();
  action();
}

/** Choose the next entry of a list and return its value. */
function next(list) {
  list.selectedIndex = (list.selectedIndex + 1) % list.options.length;
  return list.value;
}

function togglePanel() {
  const isHidden = (element("panel").hidden = !element("panel").hidden);
  element("hide").setAttribute("aria-expanded", String(!isHidden));
}

function setMode(mode) {
  const modes = [...element("mode").options].map(({ value }) => value);
  if (stage.sides.length < 2 || !modes.includes(mode)) mode = "first";
  element("mode").value = stage.mode = mode;
  element("divider").hidden = mode !== "split";
  // With one side shown, the name of the other is not.
  const isAlone = stage.sides.length === 2 && ["first", "second"].includes(mode);
  ["first", "second"].forEach((name, k) => (element(`side-${k}`).style.opacity = isAlone && name !== mode ? 0.25 : 1));
  placeDivider();
}

function setControl(kind) {
  const reach = camera.position.distanceTo(orbit.target);
  if (kind === "orbit" && state.fly) {
    // Turns around what is in the middle of the picture now.
    orbit.target.copy(camera.getWorldDirection(new THREE.Vector3()).multiplyScalar(reach).add(camera.position));
  }
  orbit.enabled = kind === "orbit";
  state.fly?.dispose();
  state.fly = kind === "fly" ? new FlyControls(camera, canvas) : null;
  if (state.fly) {
    Object.assign(state.fly, { movementSpeed: reach / 3, rollSpeed: 0.4, dragToLook: true });
    canvas.focus();
  }
}

function dragDivider(event) {
  const divider = element("divider");
  divider.setPointerCapture(event.pointerId);
  divider.onpointermove = ({ clientX }) => setSplit(clientX / innerWidth);
  divider.onpointerup = divider.onpointercancel = () => (divider.onpointermove = null);
}

function moveDivider(event) {
  const steps = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 };
  if (!(event.key in steps)) return;
  event.preventDefault();
  event.stopPropagation();
  setSplit(stage.split + steps[event.key]);
}

function setSplit(split) {
  stage.split = Math.min(1, Math.max(0, split));
  placeDivider();
}

function placeDivider() {
  element("divider").style.left = `${100 * stage.split}%`;
  element("divider").setAttribute("aria-valuenow", Math.round(100 * stage.split));
  touch();
}

function resize() {
  stage.resize(innerWidth, innerHeight);
  camera.aspect = innerWidth / innerHeight;
  fitField();
  touch();
}

function setPlaying(playing) {
  state.playing = playing && longest() !== null;
  if (state.playing && state.t >= 1) seek(0);
  element("play").setAttribute("aria-pressed", String(state.playing));
  element("play").setAttribute("aria-label", state.playing ? "pause" : "play");
}

/** Step to the next stored keyframe. */
function step(direction) {
  const player = longest();
  if (!player) return;
  setPlaying(false);
  const later = player.keyTimes.filter((t) => (direction > 0 ? t > state.t + 1e-9 : t < state.t - 1e-9));
  if (later.length) seek(direction > 0 ? later[0] : later.at(-1));
}

/** Show a normalized time; while one is being prepared, only the last wish is kept. */
async function seek(t) {
  state.t = t;
  showTime();
  state.wanted = t;
  if (state.busy) return;
  state.busy = true;
  try {
    while (state.wanted !== undefined) {
      const wanted = state.wanted;
      state.wanted = undefined;
      const players = state.sources.map((source) => source.player).filter(Boolean);
      await Promise.all(players.map((each) => each.show(wanted, element("interpolation").value)));
      touch();
    }
  } catch (error) {
    setPlaying(false);
    await explain(state.sources.find((source) => source.player)?.file ?? config.files[0], error);
  } finally {
    state.busy = false;
  }
}

/** Time and place among the keyframes. */
function showTime() {
  element("time").value = state.t;
  const times = longest()?.keyTimes;
  if (!times) return;
  const before = Math.max(0, times.findLastIndex((time) => time <= state.t));
  const span = before + 1 < times.length ? times[before + 1] - times[before] : 0;
  const frame = before + (span > 0 ? Math.max(0, state.t - times[before]) / span : 0);
  element("time-text").textContent = `${state.t.toFixed(3)} · frame ${frame.toFixed(1)} of ${times.length}`;
}

let last = performance.now();
const shown = new THREE.Matrix4();
function loop(now) {
  requestAnimationFrame(loop);
  const seconds = Math.min((now - last) / 1000, LONGEST_STEP);
  last = now;
  state.fly?.update(seconds);
  if (orbit.enabled) orbit.update();
  if (state.playing) advance(seconds);
  camera.updateMatrixWorld();
  if (!shown.equals(camera.matrixWorld)) touch();
  shown.copy(camera.matrixWorld);
  // What does not change is not drawn again.
  if (stage.isBusy()) touch();
  if (!window.viewer.paused && (now < state.until || state.owed > 0)) {
    stage.draw(camera);
    state.drawn++;
    state.owed--;
  } else if (window.viewer.ready) element("loading").hidden = true;
  if (now - state.since > 500) showStatistics(now);
}

/** Go on by the clock: keyframes that come too late are skipped, the speed stays. */
function advance(seconds) {
  const player = longest();
  const t = state.t + (seconds * Number(element("speed").value) * DEFAULT_FPS) / Math.max(1, player.frameCount - 1);
  if (t < 1) seek(t);
  else if (element("loop").checked) seek(t % 1);
  else {
    setPlaying(false);
    seek(1);
  }
}

function showStatistics(now) {
  const seconds = (now - state.since) / 1000;
  const parts = state.drawn ? [`${Math.round(state.drawn / seconds)} pictures/s`] : [];
  const players = state.sources.map((source) => source.player).filter((player) => player?.frameCount > 1);
  if (players.length) {
    const decoded = players.reduce((sum, player) => sum + player.decoded, 0);
    parts.push(`${Math.round((decoded - (state.decoded ?? 0)) / seconds)} keyframes decoded/s`);
    state.decoded = decoded;
  }
  element("statistics").textContent = now < state.noticeUntil ? state.notice : parts.join(" · ");
  [state.drawn, state.since] = [0, now];
}

function currentCamera() {
  return describeCamera(camera, innerWidth, innerHeight, config.world);
}

/** The camera in the coordinates that are drawn, which are not always the file's. */
function pageCamera() {
  return describeCamera(camera, innerWidth, innerHeight);
}

/** The address of this view and time. */
function writeLink() {
  const numbers = [...camera.position.toArray(), ...camera.quaternion.toArray(), ...orbit.target.toArray()];
  const view = { c: numbers.map((value) => Number(value.toPrecision(7))).join(","), f: Number(state.fovY.toPrecision(7)) };
  const parts = { ...view, t: state.t, m: stage.mode, s: stage.split };
  history.replaceState(null, "", `#${new URLSearchParams(parts)}`);
  return location.href;
}

function readLink() {
  const parts = new URLSearchParams(location.hash.slice(1));
  const numbers = (parts.get("c") ?? "").split(",").map(Number);
  if (numbers.length === 10 && numbers.every(Number.isFinite)) {
    camera.position.fromArray(numbers);
    camera.quaternion.fromArray(numbers, 3);
    orbit.target.fromArray(numbers, 7);
    orbit.update();
  }
  const number = (name) => (parts.has(name) ? Number(parts.get(name)) : NaN);
  const [t, split, field] = ["t", "s", "f"].map(number);
  if (field > 0 && field < 180) state.fovY = field;
  fitField();
  if (split >= 0 && split <= 1) stage.split = split;
  if (parts.has("m")) setMode(parts.get("m"));
  if (t >= 0 && t <= 1) seek(t);
}

async function copy(text, what) {
  try {
    await navigator.clipboard.writeText(text);
    [state.notice, state.noticeUntil] = [`${what} copied`, performance.now() + 2000];
    showStatistics(performance.now());
  } catch {
    say(text); // no clipboard here: to be copied by hand
  }
  window.viewer.copied = text;
}

/** What tests and scripts of the page may use. */
window.viewer = { ready: false, paused: false, config, stage, state, seek, currentCamera, pageCamera, copied: "" };
