/** The page of gsplat-inspect view: opens the files of its configuration and lets people look at them. */
import "./style.css";
import * as THREE from "three";
import { FlyControls } from "three/addons/controls/FlyControls.js";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { openSource } from "./sources.js";
import { describeCamera, exactCamera, Stage } from "./stage.js";

const DEFAULT_FPS = 30;
const element = (id) => document.getElementById(id);
const config = JSON.parse(element("config").textContent);
const canvas = element("canvas");
const stage = new Stage(canvas);
const camera = new THREE.PerspectiveCamera(50, 1, 0.01, 1000);
const state = { sources: [], t: 0, playing: false, orbit: null, fly: null, busy: false, drawn: 0, since: performance.now() };

start();

async function start() {
  setUpCamera();
  listen();
  requestAnimationFrame(loop);
  for (const [index, file] of config.files.entries()) {
    element(`name-${index}`).textContent = file.note ? `${file.name} (${file.note})` : file.name;
    try {
      if (file.error) throw new Error(file.error);
      const source = await openSource(file);
      state.sources.push({ ...source, file });
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
  element("mode-label").hidden = stage.sides.length < 2;
  setMode(stage.sides.length < 2 ? "first" : "split");
  readLink();
  window.viewer.ready = true;
}

/** Tell what is wrong with a file, in the validator's words where the server has them. */
async function explain(file, error) {
  let words = `${file.name}: ${error?.message ?? error}`;
  if (file.report) {
    const found = await fetch(file.report)
      .then((response) => response.json())
      .catch(() => null);
    const lines = (found?.issues ?? []).map(({ severity, code, message }) => `${severity} ${code}: ${message}`);
    if (lines.length) words = `${file.name} is not valid:\n${lines.join("\n")}`;
  }
  say(element("message").hidden ? words : `${element("message").textContent}\n\n${words}`);
}

function say(text) {
  element("message").textContent = text;
  element("message").hidden = false;
}

function longest() {
  return state.sources.map(({ player }) => player).find((player) => player?.frameCount > 1) ?? null;
}

function setUpCamera(given = config.cameras[0]) {
  if (!given) return;
  const exact = exactCamera(given);
  exact.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.scale.set(1, 1, 1);
  camera.fov = THREE.MathUtils.radToDeg(2 * Math.atan(given.height / 2 / given.K[1][1]));
  [camera.near, camera.far] = [given.near, given.far];
  if (config.up) camera.up.set(...config.up);
  camera.updateProjectionMatrix();
  state.orbit ??= Object.assign(new OrbitControls(camera, canvas), { enableDamping: false });
  state.orbit.target.set(...(config.center ?? [0, 0, 0]));
  state.orbit.update();
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
  element("degree").onchange = ({ target }) => stage.limitDegree(Number(target.value));
  element("control").onchange = ({ target }) => setControl(target.value);
  element("reset").onclick = () => setUpCamera();
  element("copy-camera").onclick = () => copy(JSON.stringify([currentCamera()], null, 1), "camera");
  element("copy-link").onclick = () => copy(writeLink(), "link");
  element("help").onclick = () => (element("keys").hidden = !element("keys").hidden);
  element("divider").onpointerdown = dragDivider;
  resize();
}

function onKey(event) {
  if (["INPUT", "SELECT"].includes(event.target.tagName) && event.key !== " ") return;
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
    p: () => (element("panel").hidden = !element("panel").hidden),
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

function setMode(mode) {
  if (stage.sides.length < 2) mode = "first";
  element("mode").value = stage.mode = mode;
  element("divider").hidden = mode !== "split" || stage.sides.length < 2;
  placeDivider();
}

function setControl(kind) {
  state.orbit.enabled = kind === "orbit";
  state.fly?.dispose();
  state.fly = kind === "fly" ? new FlyControls(camera, canvas) : null;
  if (state.fly) {
    const reach = camera.position.distanceTo(state.orbit.target);
    Object.assign(state.fly, { movementSpeed: reach / 3, rollSpeed: 0.4, dragToLook: true });
    canvas.focus();
  }
}

function dragDivider(event) {
  const divider = element("divider");
  divider.setPointerCapture(event.pointerId);
  divider.onpointermove = ({ clientX }) => {
    stage.split = Math.min(1, Math.max(0, clientX / innerWidth));
    placeDivider();
  };
  divider.onpointerup = () => (divider.onpointermove = null);
}

function placeDivider() {
  element("divider").style.left = `${100 * stage.split}%`;
}

function resize() {
  stage.resize(innerWidth, innerHeight);
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
}

function setPlaying(playing) {
  state.playing = playing && longest() !== null;
  element("play").textContent = state.playing ? "⏸" : "▶";
}

/** Step to the next stored keyframe. */
function step(direction) {
  const player = longest();
  if (!player) return;
  setPlaying(false);
  const times = player.times ?? Array.from({ length: player.frameCount }, (_, k) => k / (player.frameCount - 1));
  const later = times.filter((t) => (direction > 0 ? t > state.t + 1e-9 : t < state.t - 1e-9));
  if (later.length) seek(direction > 0 ? later[0] : later.at(-1));
}

/** Show a normalized time; while one is being prepared, only the last wish is kept. */
async function seek(t) {
  state.t = t;
  element("time").value = t;
  const player = longest();
  if (player) element("time-text").textContent = `${t.toFixed(3)} · frame ${(t * (player.frameCount - 1)).toFixed(1)}`;
  state.wanted = t;
  if (state.busy) return;
  state.busy = true;
  try {
    while (state.wanted !== undefined) {
      const wanted = state.wanted;
      state.wanted = undefined;
      const players = state.sources.map((source) => source.player).filter(Boolean);
      await Promise.all(players.map((each) => each.show(wanted, element("interpolation").value)));
    }
  } catch (error) {
    setPlaying(false);
    await explain(state.sources.find((source) => source.player)?.file ?? config.files[0], error);
  } finally {
    state.busy = false;
  }
}

let last = performance.now();
function loop(now) {
  requestAnimationFrame(loop);
  const seconds = (now - last) / 1000;
  last = now;
  state.fly?.update(seconds);
  if (state.orbit?.enabled) state.orbit.update();
  if (state.playing && !state.busy) advance(seconds);
  if (!window.viewer.paused) stage.draw(camera);
  state.drawn++;
  if (now - state.since > 500) showStatistics(now);
}

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
  const parts = state.sources.map(({ splats, file }) => `${splats.toLocaleString("en")} splats, ${file.bytes.toLocaleString("en")} bytes`);
  parts.push(`${Math.round(state.drawn / seconds)} pictures/s`);
  const players = state.sources.map((source) => source.player).filter((player) => player?.frameCount > 1);
  if (players.length) {
    const decoded = players.reduce((sum, player) => sum + player.decoded, 0);
    parts.push(`${Math.round((decoded - (state.decoded ?? 0)) / seconds)} keyframes decoded/s`);
    state.decoded = decoded;
  }
  element("statistics").textContent = parts.join(" · ");
  [state.drawn, state.since] = [0, now];
}

function currentCamera() {
  return describeCamera(camera, innerWidth, innerHeight);
}

/** The address of this view and time. */
function writeLink() {
  const numbers = [...camera.position.toArray(), ...camera.quaternion.toArray(), ...state.orbit.target.toArray()];
  const parts = { c: numbers.map((value) => Number(value.toPrecision(7))).join(","), t: state.t, m: stage.mode, s: stage.split };
  history.replaceState(null, "", `#${new URLSearchParams(parts)}`);
  return location.href;
}

function readLink() {
  const parts = new URLSearchParams(location.hash.slice(1));
  const numbers = (parts.get("c") ?? "").split(",").map(Number);
  if (numbers.length === 10 && numbers.every(Number.isFinite)) {
    camera.position.fromArray(numbers);
    camera.quaternion.fromArray(numbers, 3);
    state.orbit.target.fromArray(numbers, 7);
    state.orbit.update();
  }
  const [t, split] = [Number(parts.get("t")), Number(parts.get("s"))];
  if (parts.has("s") && split >= 0 && split <= 1) stage.split = split;
  if (parts.has("m")) setMode(parts.get("m"));
  if (t >= 0 && t <= 1) seek(t);
}

async function copy(text, what) {
  try {
    await navigator.clipboard.writeText(text);
    element("statistics").textContent = `${what} copied`;
  } catch {
    say(text); // no clipboard here: to be copied by hand
  }
  window.viewer.copied = text;
}

/** What tests and scripts of the page may use. */
window.viewer = { ready: false, paused: false, config, stage, state, seek, currentCamera, copied: "" };
