// The scene as splats, free to turn, with finished close-ups pinned to where they are: a click flies
// there and fades to the picture. DATA is written by scene_page.py, SPLATS is three.js and Spark.
"use strict";

(async () => {
  const FLIGHT = 1400; // milliseconds
  const element = (id) => document.getElementById(id);
  const state = (name) => { document.body.dataset.state = name; };
  const say = (text) => { element("said").textContent = text; };
  const { closeups, overview } = DATA;
  let shown = -1; // index of the close-up that is shown or flown to
  let flight = null;
  let view = null; // the scene's canvas and camera; null where the browser cannot draw it

  function makeView() {
    const S = SPLATS;
    const canvas = element("canvas");
    const renderer = new S.WebGLRenderer({ canvas, antialias: false });
    renderer.setPixelRatio(Math.min(devicePixelRatio, 1.5));
    const scene = new S.Scene();
    const camera = new S.PerspectiveCamera(50, 1, overview.distance / 1000, overview.distance * 100);
    camera.up.fromArray(DATA.up);
    const controls = new S.OrbitControls(camera, canvas);
    controls.enableDamping = true;
    const made = { renderer, scene, camera, controls, dirty: true };
    scene.add(new S.SparkRenderer({ renderer, onDirty: () => { made.dirty = true; } }));
    controls.addEventListener("change", () => { made.dirty = true; });
    controls.addEventListener("start", leave);
    return made;
  }

  async function loadSplats() {
    const bytes = Uint8Array.from(atob(DATA.splats), (letter) => letter.charCodeAt(0));
    delete DATA.splats;
    const mesh = new SPLATS.SplatMesh({ fileBytes: bytes, fileType: "spz" });
    await mesh.initialized;
    view.scene.add(mesh);
    view.dirty = true;
  }

  // A camera in the window: all of a picture of this aspect is in view, as an image with
  // object-fit: contain lies over it.
  function fieldOfView(place) {
    const half = Math.tan(place.fov * Math.PI / 360);
    const window = innerWidth / innerHeight;
    return 360 / Math.PI * Math.atan(half * Math.max(1, place.aspect / window));
  }

  function poseOf(place) {
    const matrix = new SPLATS.Matrix4().fromArray(place.matrix);
    return {
      position: new SPLATS.Vector3().setFromMatrixPosition(matrix),
      turn: new SPLATS.Quaternion().setFromRotationMatrix(matrix),
      fov: fieldOfView(place),
      target: new SPLATS.Vector3().fromArray(place.target),
    };
  }

  function fly(place, arrived) {
    const { camera, controls } = view;
    const from = {
      position: camera.position.clone(), turn: camera.quaternion.clone(), fov: camera.fov,
      distance: camera.position.distanceTo(controls.target),
    };
    const to = poseOf(place);
    to.distance = to.position.distanceTo(to.target);
    controls.enabled = false;
    state("flying");
    flight = { from, to, begin: performance.now(), arrived };
  }

  function moveAlong(now) {
    const { from, to, begin, arrived } = flight;
    const time = Math.min(1, (now - begin) / FLIGHT);
    const eased = time * time * (3 - 2 * time);
    // What lies ahead grows by the same factor in equal times.
    const nearer = to.distance / from.distance;
    const way = Math.abs(nearer - 1) < 1e-3 ? eased : (nearer ** eased - 1) / (nearer - 1);
    const { camera, controls } = view;
    camera.position.lerpVectors(from.position, to.position, way);
    camera.quaternion.slerpQuaternions(from.turn, to.turn, eased);
    camera.fov = from.fov + (to.fov - from.fov) * eased;
    camera.updateProjectionMatrix();
    view.dirty = true;
    if (time < 1) return;
    flight = null;
    controls.target.copy(to.target);
    controls.enabled = true;
    arrived();
  }

  function mark() {
    [...element("strip").children].forEach((button, index) => {
      button.setAttribute("aria-current", String(index === shown));
    });
  }

  function setPicture(error) {
    const closeup = closeups[shown];
    element("picture").src = error ? closeup.error : closeup.picture;
    element("picture").alt = closeup.name;
    const full = element("full");
    full.href = element("picture").src;
    if (full.href.startsWith("data:")) { // browsers open no such address, but they save it
      full.download = `${closeup.name}${error ? "_error" : ""}.webp`;
      full.textContent = "Save the picture";
    }
    element("error").setAttribute("aria-pressed", String(error));
    element("legend").hidden = !error;
    say(error ? closeup.said_of_error : closeup.said);
  }

  function show(index) {
    shown = index;
    mark();
    setPicture(false);
    if (view === null) return state("shown");
    fly(closeups[index], () => state("shown"));
  }

  function leave() {
    if (document.body.dataset.state !== "shown") return;
    shown = -1;
    mark();
    element("legend").hidden = true;
    state("free");
    say(DATA.said);
  }

  function back() {
    if (document.body.dataset.state !== "shown") return;
    leave();
    if (view !== null) fly(overview, () => state("free"));
  }

  function addButtons() {
    closeups.forEach((closeup, index) => {
      const small = document.createElement("button");
      small.title = closeup.said;
      small.innerHTML = `<img alt=""><span>${index + 1}</span>`;
      small.firstChild.src = closeup.thumbnail;
      small.addEventListener("click", () => show(index));
      element("strip").append(small);
      const pin = document.createElement("button");
      pin.className = "pin";
      pin.textContent = index + 1;
      pin.title = closeup.said;
      pin.addEventListener("click", () => show(index));
      element("pins").append(pin);
    });
    element("error").addEventListener("click", () => {
      setPicture(element("error").getAttribute("aria-pressed") !== "true");
    });
    element("back").addEventListener("click", back);
    addEventListener("keydown", (event) => { if (event.key === "Escape") back(); });
  }

  function placePins() {
    const point = new SPLATS.Vector3();
    [...element("pins").children].forEach((pin, index) => {
      point.fromArray(closeups[index].point).project(view.camera);
      pin.style.visibility = Math.abs(point.z) < 1 ? "visible" : "hidden";
      pin.style.left = `${50 * (1 + point.x)}%`;
      pin.style.top = `${50 * (1 - point.y)}%`;
    });
  }

  function resize() {
    if (view === null) return;
    view.renderer.setSize(innerWidth, innerHeight, false);
    view.camera.aspect = innerWidth / innerHeight;
    view.camera.fov = fieldOfView(shown < 0 ? overview : closeups[shown]);
    view.camera.updateProjectionMatrix();
    view.dirty = true;
  }

  function frame(now) {
    requestAnimationFrame(frame);
    if (flight !== null) moveAlong(now);
    else if (view.controls.enabled && document.body.dataset.state === "free") view.controls.update();
    if (!view.dirty) return;
    view.dirty = false;
    view.renderer.render(view.scene, view.camera);
    placePins();
  }

  addButtons();
  element("legend").src = DATA.legend;
  try {
    view = makeView();
    const start = poseOf(overview);
    view.camera.position.copy(start.position);
    view.camera.quaternion.copy(start.turn);
    view.controls.target.copy(start.target);
    resize();
    addEventListener("resize", resize);
    await loadSplats();
    requestAnimationFrame(frame);
    state("free");
    say(DATA.said);
  } catch (error) {
    console.error(error);
    view = null;
    element("pins").replaceChildren(); // they would lie anywhere
    state("free");
    say("This browser cannot draw the scene (it needs WebGL 2); its close-ups are below.");
  }
})();
