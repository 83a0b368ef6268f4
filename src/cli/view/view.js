const parameters = new URLSearchParams(location.search);
const token = parameters.get("token") ?? "";
const element = (id) => document.getElementById(id);
const all = (selector) => document.querySelectorAll(selector);
const canvas = element("map");
const context = canvas.getContext("2d");
const dark = matchMedia("(prefers-color-scheme: dark)");

let robot = parameters.get("robot");
let socket, retry, robots = [], tool = null, drag = null;
// What is known of the robot, and whether it left the last question unanswered.
let scene = {}, trail = [], tiles = new Map(), head = null, isSilent = false;
// Tiles of a version that is not whole yet, and whether it has none of those before.
let arriving = new Map(), isAnew = false;
// Metres at the middle of the canvas, CSS pixels a metre.
const eye = { x: 0, y: 0, scale: 20, fits: true };
const shown = { scan: true, path: true, particles: true };

const query = (more) => new URLSearchParams({ ...(token && { token }), ...more });
const isAlive = () => robots.some(({ name, is_alive }) => name === robot && is_alive);

// --- What comes ---

function connect() {
  clearTimeout(retry);
  const address = new URL(`socket?${query(robot !== null && { robot })}`, location);
  address.protocol = location.protocol.replace("http", "ws");
  const mine = socket = new WebSocket(address);
  let hasNews = false, order = Promise.resolve();
  socket.binaryType = "arraybuffer";
  socket.onopen = forget;
  socket.onmessage = ({ data }) => {
    hasNews = true;
    order = order.then(() => mine === socket && take(data)).catch(console.error);
  };
  socket.onclose = () => {
    if (mine !== socket) return;
    showState("bad", "not connected", hasNews ? "gmapd view has ended." :
      "gmapd view does not answer, or wants the address that it printed, with its token.");
    element("map").classList.add("gone");
    retry = setTimeout(connect, 1000);
  };
}

function forget() {
  [scene, trail, tiles, head, isSilent] = [{}, [], new Map(), null, false];
  [arriving, isAnew] = [new Map(), false];
}

function choose(name) {
  robot = name;
  eye.fits = true;
  use(null);
  history.replaceState(null, "", `?${query({ robot })}`);
  socket.onclose = null;
  socket.close();
  forget();
  connect();
  show();
}

async function take(data) {
  if (typeof data !== "string") {
    await takeTiles(data);
  } else {
    const news = JSON.parse(data);
    if (news.clear) [arriving, isAnew] = [new Map(), true];
    if (news.robots) takeRobots(news.robots);
    if (news.path) trail = news.path.slice(-2);
    if (news.pose && scene.path) follow(news.pose);
    if ("status" in news) isSilent = news.status === null;
    // Who does not answer is shown as it was.
    if (isSilent) delete news.status;
    Object.assign(scene, news);
    if (news.status) showStatus(news.status);
    else if (isSilent) show();
  }
  requestDraw();
}

// The way since the path was told. A pose that was set does not continue it.
function follow({ x, y }) {
  const last = trail.slice(-2);
  if (last.length && distance(last, [x, y]) > 1) trail = [];
  trail.push(x, y);
}

function takeRobots(news) {
  robots = news;
  if (robot === null && robots.some(({ is_alive }) => is_alive)) {
    choose(robots.find(({ is_alive }) => is_alive).name);
  }
  show();
}

// The layout is in docs/mesh.md.
async function takeTiles(buffer) {
  const view = new DataView(buffer);
  const [u16, i32] = ["getUint16", "getInt32"]
    .map((name) => (at) => view[name](at, true));
  const side = u16(76);
  let at = 80;
  for (let left = u16(78); left > 0; left--) {
    const [tx, ty, length] = [i32(at), i32(at + 4), u16(at + 24)];
    const packed = new Blob([new Uint8Array(buffer, at + 26, length)]);
    const stream = packed.stream().pipeThrough(new DecompressionStream("deflate-raw"));
    const cells = new Int8Array(await new Response(stream).arrayBuffer());
    const known = cells.reduce((count, cell) => count + (cell >= 0), 0);
    arriving.set(`${tx}:${ty}`, { tx, ty, cells, known, pictures: new Map() });
    at += 26 + length;
  }
  if (u16(4) + 1 < u16(6)) return;
  tiles = isAnew ? arriving : new Map([...tiles, ...arriving]);
  [arriving, isAnew] = [new Map(), false];
  head = { resolution: view.getFloat64(40, true), side };
  if (eye.fits) fit();
}

// --- What is said ---

const VERDICTS = {
  processed: "in the map", not_moved_enough: "not moved enough since the last in the map",
  throttled: "left out, as throttle_scans says", no_usable_beams: "without a usable beam",
  bad_odometry: "with odometry that makes no sense",
  not_localized: "whose place in the map cannot be told", no_odometry: "without odometry",
  no_mount: "from a laser whose place is not known", tilted_mount: "from a tilted laser",
  bad_geometry: "whose angles or ranges make no sense", not_decodable: "that cannot be read",
  duplicate: "that came twice", late: "that came after a newer one",
  overload: "too many to keep up with", paused: "while paused",
};
const STATES = {
  waiting_for_scans: "warning", waiting_for_odometry: "warning", not_localized: "warning",
  mapping: "good", localizing: "good", degraded: "bad", paused: "warning",
};
const words = (name) => name.replaceAll("_", " ");

function show() {
  const links = robots.map(({ name, is_alive }) => {
    const link = make("a", name || "(no name)");
    link.href = `?${query({ robot: name })}`;
    link.classList.toggle("gone", !is_alive);
    if (name === robot) link.setAttribute("aria-current", "true");
    link.onclick = (event) => { event.preventDefault(); choose(name); };
    return link;
  });
  element("robots").replaceChildren(...links);
  canvas.classList.toggle("gone", !isAlive());
  for (const button of all("[data-command], [data-tool=initial_pose]")) {
    button.disabled = !isAlive();
  }
  for (const link of all("[data-format]")) {
    if (isAlive()) link.href = `map/${link.dataset.format}?${query({ robot })}`;
    else link.removeAttribute("href");
  }
  document.title = robot ? `${robot} – gmapd` : "gmapd";
  if (robot === null) {
    showState("warning", "no robot", "No gmapd run is alive on this mesh.");
  } else if (isAlive() && isSilent) {
    showState("warning", "does not answer", "What is shown was last seen.");
  } else if (isAlive() && scene.status) {
    showStatus(scene.status);
  } else if (isAlive()) {
    showState("warning", "asking", "");
  } else {
    showState("bad", "gone", scene.status ? "It does not answer any more; this is what was last seen."
      : "It is not on this mesh.");
  }
  requestDraw();
}

function showStatus(status) {
  if (!isAlive()) return;
  showState(STATES[status.state] ?? "warning", words(status.state), status.detail);
  const [pause] = all("[data-command=pause], [data-command=resume]");
  pause.dataset.command = status.state === "paused" ? "resume" : "pause";
  pause.textContent = status.state === "paused" ? "Resume" : "Pause";
  const { map, milliseconds_per_scan: spread, filter } = status;
  element("facts").replaceChildren(...[
    ["Map", map ? `${map.known_area_m2.toFixed(0)} m² known` : "none yet"],
    map && ["Cells", `${map.width} × ${map.height}, ${map.resolution} m`],
    ["Pose", pose(scene.pose ?? status.pose_in_map)],
    spread && ["Speed", `${spread.p50.toFixed(1)} ms a scan`],
    filter?.particles > 1 && ["Particles", filter.particles],
  ].filter(Boolean).flatMap(([name, value]) => [make("dt", name), make("dd", value)]));
  const counts = Object.entries(status.scans ?? {}).filter(([, count]) => count > 0);
  element("scans").replaceChildren(...counts.flatMap(([verdict, count]) => {
    const what = make("dd", VERDICTS[verdict] ?? words(verdict));
    const detail = status.last_details?.[verdict];
    if (detail && verdict !== "processed") what.append(make("small", detail));
    return [make("dt", count), what];
  }));
}

const pose = ({ x, y, theta }) =>
  `${x.toFixed(2)} m, ${y.toFixed(2)} m, ${Math.round(theta * 180 / Math.PI) || 0}°`;

function showState(kind, word, detail) {
  element("state").className = kind;
  element("state").querySelector("b").textContent = word;
  element("state").querySelector("span").textContent = detail;
}

let silence;
function say(text, kind = "") {
  const said = element("said");
  [said.textContent, said.className, said.hidden] = [text, kind, !text];
  clearTimeout(silence);
  if (!tool) silence = setTimeout(() => { said.hidden = true; }, 6000);
}

function make(name, text) {
  const made = document.createElement(name);
  made.textContent = text;
  return made;
}

// --- What is drawn ---

let isDrawing = false;
function requestDraw() {
  if (isDrawing) return;
  isDrawing = true;
  requestAnimationFrame(() => { isDrawing = false; draw(); });
}

const toScreen = (x, y) => [canvas.clientWidth / 2 + (x - eye.x) * eye.scale,
  canvas.clientHeight / 2 - (y - eye.y) * eye.scale];
const toMap = (x, y) => [eye.x + (x - canvas.clientWidth / 2) / eye.scale,
  eye.y - (y - canvas.clientHeight / 2) / eye.scale];

function draw() {
  const [width, height] = [canvas.clientWidth, canvas.clientHeight].map(
    (length) => Math.round(length * devicePixelRatio));
  if (canvas.width !== width || canvas.height !== height) {
    [canvas.width, canvas.height] = [width, height];
  }
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.clearRect(0, 0, width, height);
  if (head) drawTiles(width, height);
  context.scale(devicePixelRatio, devicePixelRatio);
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(`--${name}`);
  if (shown.path) drawLine(scene.path ?? [], colour("path"), 2);
  if (shown.path) drawLine(trail, colour("path"), 2);
  const isLive = isAlive() && !["paused", "waiting_for_scans"].includes(scene.status?.state);
  if (shown.scan && isLive) drawDots(scene.scan ?? [], colour("scan"), 2.5);
  if (shown.particles) drawDots(scene.particles ?? [], colour("particles"), 2);
  const now = scene.pose ?? scene.status?.pose_in_map;
  if (now) drawPose(now, colour(isAlive() ? "accent" : "faint"));
  if (drag) drawDrag(colour("good"));
  drawScale();
}

function drawTiles(width, height) {
  const ratio = devicePixelRatio;
  // Cells a pixel, as a power of two: the largest value of each square of cells is drawn.
  const cells = 1 / (eye.scale * ratio * head.resolution);
  const step = Math.min(2 ** Math.max(0, Math.floor(Math.log2(cells))), head.side);
  context.imageSmoothingEnabled = cells > 1;
  const metres = head.side * head.resolution;
  for (const tile of tiles.values()) {
    const place = (column, row) => toScreen(column * metres, row * metres)
      .map((length) => Math.round(length * ratio));
    const [left, top] = place(tile.tx, tile.ty + 1);
    const [right, bottom] = place(tile.tx + 1, tile.ty);
    if (right < 0 || bottom < 0 || left > width || top > height) continue;
    if (!tile.pictures.has(step)) tile.pictures.set(step, picture(tile.cells, step));
    context.drawImage(tile.pictures.get(step), left, top, right - left, bottom - top);
  }
}

// The first row of cells is the lowest.
function picture(cells, step) {
  const { side } = head;
  const size = side / step;
  const image = new ImageData(size, size);
  const pixels = new Uint32Array(image.data.buffer);
  const [free, occupied] = dark.matches ? [0xff3d352e, 0xfff5f0ec] : [0xffffffff, 0xff2b221b];
  const largest = new Int8Array(size * size).fill(-1);
  for (let i = 0; i < cells.length; i++) {
    const row = size - 1 - Math.floor(Math.floor(i / side) / step);
    const at = row * size + Math.floor(i % side / step);
    if (cells[i] > largest[at]) largest[at] = cells[i];
  }
  largest.forEach((cell, i) => { pixels[i] = cell < 0 ? 0 : cell > 50 ? occupied : free; });
  const target = new OffscreenCanvas(size, size);
  target.getContext("2d").putImageData(image, 0, 0);
  return target;
}

function drawLine(points, colour, width) {
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.lineJoin = "round";
  context.beginPath();
  for (let i = 0; i < points.length; i += 2) {
    context.lineTo(...toScreen(points[i], points[i + 1]));
  }
  context.stroke();
}

function drawDots(points, colour, size) {
  context.fillStyle = colour;
  for (let i = 0; i < points.length; i += 2) {
    const [x, y] = toScreen(points[i], points[i + 1]);
    context.fillRect(x - size / 2, y - size / 2, size, size);
  }
}

function drawPose({ x, y, theta }, colour) {
  context.save();
  context.translate(...toScreen(x, y));
  context.rotate(-theta);
  context.beginPath();
  [[14, 0], [-9, 9], [-5, 0], [-9, -9]].forEach((point) => context.lineTo(...point));
  context.closePath();
  context.lineJoin = "round";
  context.lineWidth = 5;
  context.strokeStyle = "#fff";
  context.stroke();
  context.fillStyle = colour;
  context.fill();
  context.restore();
}

function drawDrag(colour) {
  const { from, to } = drag;
  drawLine([...from, ...to], colour, 3);
  if (tool === "initial_pose") drawPose(poseOf(drag), colour);
  else drawDots([...from, ...to], colour, 9);
}

const poseOf = ({ from: [x, y], to }) => ({ x, y, theta: Math.atan2(to[1] - y, to[0] - x) });

function drawScale() {
  element("scale").hidden = !head;
  const most = 110 / eye.scale;
  const power = 10 ** Math.floor(Math.log10(most));
  const length = [5, 2, 1].find((factor) => factor * power <= most) * power;
  element("scale").style.width = `${length * eye.scale}px`;
  element("scale").firstElementChild.textContent =
    length < 1 ? `${Math.round(length * 100)} cm` : `${length} m`;
}

// --- Looking about ---

// The tiles of which more than stray cells are known, into the part of the window that the panel
// leaves free.
function fit() {
  const seen = [...tiles.values()].filter(({ known }) => known > head.side ** 2 / 16);
  const [columns, rows] = [seen.map(({ tx }) => tx), seen.map(({ ty }) => ty)];
  if (seen.length === 0) return;
  const panel = document.querySelector("aside").getBoundingClientRect();
  const isBelow = panel.width >= innerWidth;
  const [left, bottom] = isBelow ? [0, innerHeight - panel.top] : [panel.right, 0];
  const [width, height] = [innerWidth - left, innerHeight - bottom];
  const metres = head.side * head.resolution;
  const [x, y] = [columns, rows].map((all) => [Math.min(...all), Math.max(...all) + 1]);
  eye.scale = 0.97 * Math.min(width / (x[1] - x[0]), height / (y[1] - y[0])) / metres;
  eye.x = (x[0] + x[1]) / 2 * metres - left / 2 / eye.scale;
  eye.y = (y[0] + y[1]) / 2 * metres - bottom / 2 / eye.scale;
}

function pan(x, y) {
  eye.x -= x / eye.scale;
  eye.y += y / eye.scale;
  eye.fits = false;
}

// The point of the map at this place stays there.
function zoom(factor, x, y) {
  const before = toMap(x, y);
  eye.scale = Math.min(Math.max(eye.scale * factor, 0.1), 2000);
  const after = toMap(x, y);
  eye.x += before[0] - after[0];
  eye.y += before[1] - after[1];
  eye.fits = false;
}

const fingers = new Map();
const place = (event) => [event.offsetX, event.offsetY];
const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
const middle = () => {
  const places = [...fingers.values()];
  return [0, 1].map((axis) => places.reduce((sum, at) => sum + at[axis], 0) / places.length);
};

canvas.onpointerdown = (event) => {
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, place(event));
  const from = toMap(...place(event));
  drag = tool && fingers.size === 1 ? { from, to: from } : null;
  requestDraw();
};
canvas.onpointermove = (event) => {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  const [now, from] = [place(event), middle()];
  fingers.set(event.pointerId, now);
  if (drag) {
    drag.to = toMap(...now);
    if (tool === "measure") say(`${distance(drag.from, drag.to).toFixed(2)} m`);
  } else {
    const to = middle();
    pan(to[0] - from[0], to[1] - from[1]);
    const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
    if (other && distance(before, other) > 0) {
      zoom(distance(now, other) / distance(before, other), ...to);
    }
  }
  requestDraw();
};
canvas.onpointerup = (event) => {
  fingers.delete(event.pointerId);
  if (drag && tool === "initial_pose") {
    const { x, y, theta } = poseOf(drag);
    if (distance(drag.from, drag.to) * eye.scale < 10) {
      say(HINTS.initial_pose);
    } else {
      use(null);
      command("initial_pose", { x, y, yaw: theta });
    }
    drag = null;
  }
  requestDraw();
};
canvas.onpointercancel = (event) => {
  fingers.delete(event.pointerId);
  drag = null;
};
canvas.onwheel = (event) => {
  event.preventDefault();
  const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 20 : 1);
  zoom(Math.exp(-pixels / (event.ctrlKey ? 100 : 500)), ...place(event));
  requestDraw();
};

// --- Buttons ---

const HINTS = {
  measure: "Drag from one place to another.",
  initial_pose: "Drag from where the robot is to where it looks.",
};

function use(name) {
  [tool, drag] = [name, null];
  for (const button of all("[data-tool]")) {
    button.setAttribute("aria-pressed", String(button.dataset.tool === tool));
  }
  canvas.classList.toggle("tool", tool !== null);
  say(HINTS[tool] ?? "");
  requestDraw();
}

// By hand, so that what is wrong is said here and not on a page in its place.
async function download(event) {
  event.preventDefault();
  const { href, textContent: format } = event.currentTarget;
  if (!href) return;
  try {
    const answer = await fetch(href);
    if (!answer.ok) return say(`${format}: ${await answer.text()}`, "bad");
    const file = make("a");
    [, file.download] = answer.headers.get("content-disposition").match(/filename="(.*)"/);
    file.href = URL.createObjectURL(await answer.blob());
    file.click();
    setTimeout(() => URL.revokeObjectURL(file.href), 60000);
  } catch (error) {
    say(`${format}: ${error.message}`, "bad");
  }
}
for (const link of all("[data-format]")) link.onclick = download;

async function command(name, values = {}) {
  try {
    const answer = await fetch(`command/${name}?${new URLSearchParams({ robot })}`, {
      method: "POST",
      headers: { "content-type": "application/json", "x-gmapd-token": token },
      body: JSON.stringify(values),
    });
    const text = await answer.text();
    if (!answer.ok) return say(`${words(name)}: ${text}`, "bad");
    const { done, files } = JSON.parse(text);
    say(files ? `${done} ${files.map(({ path }) => path).join(", ")}` : done);
  } catch (error) {
    say(`${words(name)}: ${error.message}`, "bad");
  }
}

for (const button of all("[data-tool]")) {
  button.onclick = () => use(tool === button.dataset.tool ? null : button.dataset.tool);
}
for (const button of all("[data-command]")) {
  button.onclick = () => {
    const name = button.dataset.command;
    if (name !== "reset" || confirm(`Forget the map of ${robot}?`)) command(name);
  };
}
for (const box of all("[data-layer]")) {
  box.onchange = () => { shown[box.dataset.layer] = box.checked; requestDraw(); };
}
element("fit").onclick = () => { eye.fits = true; fit(); requestDraw(); };
element("more").open = innerWidth > 640;
element("more").ontoggle = () => { if (eye.fits) fit(); requestDraw(); };
dark.onchange = () => {
  for (const tile of tiles.values()) tile.pictures.clear();
  requestDraw();
};
addEventListener("resize", () => { if (eye.fits) fit(); requestDraw(); });
connect();
