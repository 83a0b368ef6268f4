const parameters = new URLSearchParams(location.search);
const token = parameters.get("token") ?? "";
const canvas = document.getElementById("map");
const context = canvas.getContext("2d");
const element = (id) => document.getElementById(id);
const dark = matchMedia("(prefers-color-scheme: dark)");

let robot = parameters.get("robot");
let socket, status, tool;
let hasNews = false;
let tiles = new Map(), head = null, path = [], particles = [];
let drag = null;
// Metres at the middle of the canvas, pixels a metre.
const eye = { x: 0, y: 0, scale: 20, follows: true };

const query = (more) => new URLSearchParams({ token, ...more });

function connect() {
  socket = new WebSocket(`ws://${location.host}/socket?${query(robot === null ? {} : { robot })}`);
  socket.binaryType = "arraybuffer";
  const mine = socket;
  let order = Promise.resolve();
  socket.onmessage = ({ data }) => {
    order = order.then(() => mine === socket && take(data)).catch(console.error);
  };
  socket.onclose = () => {
    if (mine !== socket) return;
    say(element("state"), hasNews ? "gmapd view does not answer." :
      "gmapd view does not let this page in: open the address that it printed.", true);
    setTimeout(connect, 1000);
  };
}

function choose(name) {
  robot = name;
  [tiles, head, path, particles, status] = [new Map(), null, [], [], undefined];
  eye.follows = true;
  history.replaceState(null, "", `?${query({ robot })}`);
  socket.onclose = null;
  socket.close();
  connect();
}

async function take(data) {
  if (typeof data !== "string") {
    await takeTiles(data);
  } else {
    const news = JSON.parse(data);
    if (news.clear) tiles = new Map();
    if (news.path) path = news.path;
    if (news.robots) takeNews(news);
  }
  requestDraw();
}

function takeNews(news) {
  hasNews = true;
  showRobots(news.robots);
  if (robot === null) {
    if (news.robots.length) choose(news.robots[0]);
    else say(element("state"), "No robot is alive on this mesh.", true);
    return;
  }
  particles = news.particles;
  const isGone = !news.status;
  status = news.status ?? status;
  const text = isGone ? `${robot} is gone.` :
    `${status.state.replaceAll("_", " ")}: ${status.detail}`;
  say(element("state"), text, isGone);
  const scans = Object.entries(status?.scans ?? {}).filter(([, count]) => count > 0);
  element("scans").replaceChildren(...scans.flatMap(([verdict, count]) =>
    [make("dt", verdict.replaceAll("_", " ")), make("dd", count)]));
}

function showRobots(robots) {
  element("robots").replaceChildren(...robots.map((name) => {
    const link = make("a", name || "(no name)");
    link.href = `?${query({ robot: name })}`;
    if (name === robot) link.ariaCurrent = "true";
    link.onclick = (event) => { event.preventDefault(); choose(name); };
    return link;
  }));
  for (const link of document.querySelectorAll("[data-format]")) {
    link.href = `map/${link.dataset.format}?${query({ robot: robot ?? "" })}`;
  }
}

// The layout is in docs/mesh.md.
async function takeTiles(buffer) {
  const view = new DataView(buffer);
  const side = view.getUint16(76, true);
  const [u32, i32] = [(at) => view.getUint32(at, true), (at) => view.getInt32(at, true)];
  head = { resolution: view.getFloat64(40, true), side,
    ix: i32(48), iy: i32(52), width: u32(56), height: u32(60) };
  let at = 80;
  for (let left = view.getUint16(78, true); left > 0; left--) {
    const [tx, ty, length] = [i32(at), i32(at + 4), view.getUint16(at + 24, true)];
    const packed = new Blob([new Uint8Array(buffer, at + 26, length)]);
    const stream = packed.stream().pipeThrough(new DecompressionStream("deflate-raw"));
    const cells = new Int8Array(await new Response(stream).arrayBuffer());
    tiles.set(`${tx}:${ty}`, { tx, ty, cells, picture: picture(cells, side) });
    at += 26 + length;
  }
  if (eye.follows) fit();
}

// The first row of cells is the lowest.
function picture(cells, side) {
  const target = new OffscreenCanvas(side, side);
  const image = new ImageData(side, side);
  const pixels = new Uint32Array(image.data.buffer);
  const [free, occupied] = dark.matches ? [0xff4a423c, 0xfff0f0f0] : [0xffffffff, 0xff202020];
  cells.forEach((cell, i) => {
    const row = side - 1 - Math.floor(i / side);
    pixels[row * side + i % side] = cell < 0 ? 0 : cell > 50 ? occupied : free;
  });
  target.getContext("2d").putImageData(image, 0, 0);
  return target;
}

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
  const ratio = devicePixelRatio;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  context.scale(ratio, ratio);
  drawTiles(width, height);
  drawLine(path, "#2f80ed");
  context.fillStyle = "#f2994a";
  for (let i = 0; i < particles.length; i += 2) {
    const [x, y] = toScreen(particles[i], particles[i + 1]);
    context.fillRect(x - 1, y - 1, 2, 2);
  }
  if (status) drawPose(status.pose_in_map, "#eb5757");
  if (drag) drawDrag();
}

function drawTiles(width, height) {
  if (!head) return;
  const metres = head.side * head.resolution;
  context.imageSmoothingEnabled = eye.scale * head.resolution < 1;
  for (const { tx, ty, picture } of tiles.values()) {
    const [left, top] = toScreen(tx * metres, (ty + 1) * metres).map(Math.round);
    const [right, bottom] = toScreen((tx + 1) * metres, ty * metres).map(Math.round);
    if (right < 0 || bottom < 0 || left > width || top > height) continue;
    context.drawImage(picture, left, top, right - left, bottom - top);
  }
}

function drawLine(points, colour) {
  context.strokeStyle = colour;
  context.lineWidth = 2;
  context.beginPath();
  for (let i = 0; i < points.length; i += 2) {
    context.lineTo(...toScreen(points[i], points[i + 1]));
  }
  context.stroke();
}

function drawPose({ x, y, theta }, colour) {
  context.save();
  context.translate(...toScreen(x, y));
  context.rotate(-theta);
  context.fillStyle = colour;
  context.beginPath();
  context.moveTo(12, 0);
  context.lineTo(-8, 7);
  context.lineTo(-8, -7);
  context.fill();
  context.restore();
}

function drawDrag() {
  const { from, to } = drag;
  drawLine([...from, ...to], "#27ae60");
  if (tool === "initial_pose") drawPose(poseOf(drag), "#27ae60");
}

const poseOf = ({ from: [x, y], to }) => ({ x, y, theta: Math.atan2(to[1] - y, to[0] - x) });

function fit() {
  if (!head || !head.width) return;
  const metres = (cells) => cells * head.resolution;
  eye.x = metres(head.ix + head.width / 2);
  eye.y = metres(head.iy + head.height / 2);
  eye.scale = 0.95 * Math.min(canvas.clientWidth / metres(head.width),
    canvas.clientHeight / metres(head.height));
}

function zoom(factor, x, y) {
  const [before_x, before_y] = toMap(x, y);
  eye.scale = Math.min(Math.max(eye.scale * factor, 0.1), 2000);
  const [after_x, after_y] = toMap(x, y);
  eye.x += before_x - after_x;
  eye.y += before_y - after_y;
  eye.follows = false;
  requestDraw();
}

const fingers = new Map();
const place = (event) => [event.offsetX, event.offsetY];

canvas.onpointerdown = (event) => {
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, place(event));
  const from = toMap(...place(event));
  drag = tool && fingers.size === 1 ? { from, to: from } : null;
};
canvas.onpointermove = (event) => {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  const now = place(event);
  const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
  fingers.set(event.pointerId, now);
  if (drag) {
    drag.to = toMap(...now);
    const metres = Math.hypot(drag.to[0] - drag.from[0], drag.to[1] - drag.from[1]);
    if (tool === "measure") say(element("said"), `${metres.toFixed(2)} m`);
  } else {
    eye.x -= (now[0] - before[0]) / eye.scale / fingers.size;
    eye.y += (now[1] - before[1]) / eye.scale / fingers.size;
    eye.follows = false;
    const length = (a) => Math.hypot(a[0] - other[0], a[1] - other[1]);
    if (other && length(before) > 0) zoom(length(now) / length(before), ...other);
  }
  requestDraw();
};
canvas.onpointerup = (event) => {
  fingers.delete(event.pointerId);
  if (drag && tool === "initial_pose") {
    const { x, y, theta } = poseOf(drag);
    command("initial_pose", { x, y, yaw: theta });
    use(null);
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
  zoom(Math.exp(-event.deltaY / 500), ...place(event));
};

async function command(name, values = {}) {
  try {
    const answer = await fetch(`command/${name}?${new URLSearchParams({ robot: robot ?? "" })}`, {
      method: "POST",
      headers: { "content-type": "application/json", "x-gmapd-token": token },
      body: JSON.stringify(values),
    });
    say(element("said"), `${name.replaceAll("_", " ")}: ${await answer.text()}`, !answer.ok);
  } catch (error) {
    say(element("said"), `${name}: ${error.message}`, true);
  }
}

function use(name) {
  tool = name;
  drag = null;
  for (const button of document.querySelectorAll("[data-tool]")) {
    button.ariaPressed = String(button.dataset.tool === tool);
  }
  requestDraw();
}

function make(name, text) {
  const made = document.createElement(name);
  made.textContent = text;
  return made;
}

function say(where, text, isWrong = false) {
  where.textContent = text;
  where.classList.toggle("wrong", isWrong);
}

for (const button of document.querySelectorAll("[data-tool]")) {
  button.onclick = () => use(tool === button.dataset.tool ? null : button.dataset.tool);
}
for (const button of document.querySelectorAll("[data-command]")) {
  const name = button.dataset.command;
  button.onclick = () => {
    if (name !== "reset" || confirm(`Forget the map of ${robot}?`)) command(name);
  };
}
element("fit").onclick = () => { eye.follows = true; fit(); requestDraw(); };
dark.onchange = () => {
  for (const tile of tiles.values()) tile.picture = picture(tile.cells, head.side);
  requestDraw();
};
addEventListener("resize", requestDraw);
connect();
