'use strict';
const $ = (id) => document.getElementById(id);
const add = (a, b, s = 1) => a.map((v, i) => v + s * b[i]);
const dot = (a, b) => a.reduce((sum, v, i) => sum + v * b[i], 0);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a); return a.map((v) => v / n); };
// Rodrigues' rotation of v about an axis of length 1.
const turn = (v, axis, angle) => {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return add(add(v.map((x) => x * c), cross(axis, v), s), axis, dot(axis, v) * (1 - c));
};
let scene, state, eye, moved = 0, movedAt = 0, shown = -1, shownStep = -1, rough = false, busy = false, ended = false;

function touched() {
  moved++;
  movedAt = performance.now();
}

function from(number) {
  const cameras = scene.cameras;
  const n = ((number % cameras.length) + cameras.length) % cameras.length;
  const { center, rotation, focal, aspect, name } = cameras[n];
  // What is turned about: the point on the axis nearest to what all cameras look at.
  const along = dot(add(scene.focus, center, -1), rotation[2]);
  eye = { center: [...center], axes: rotation.map((row) => [...row]), focal, aspect, distance: along > 0 ? along : 1 };
  $('camera').value = n;
  $('name').textContent = name;
  touched();
}

function settle() {
  // Right, down and ahead stay at right angles.
  const ahead = unit(eye.axes[2]);
  const right = unit(cross(eye.axes[1], ahead));
  eye.axes = [right, cross(ahead, right), ahead];
  $('name').textContent = '';
  touched();
}

function orbit(dx, dy) {
  const target = add(eye.center, eye.axes[2], eye.distance);
  const about = (axis, angle) => {
    eye.axes = eye.axes.map((row) => turn(row, axis, angle));
    eye.center = add(target, turn(add(eye.center, target, -1), axis, angle));
  };
  // Over the poles, down would become up.
  about(scene.up, -dx * 0.006);
  const tilt = Math.asin(Math.max(-1, Math.min(1, dot(eye.axes[2], scene.up))));
  const angle = Math.max(-1.5, Math.min(1.5, tilt - dy * 0.006)) - tilt;
  about(unit(eye.axes[0]), angle);
  settle();
}

function pan(dx, dy) {
  const scale = eye.distance / (eye.focal[0] * $('stage').clientWidth);
  eye.center = add(add(eye.center, eye.axes[0], -dx * scale), eye.axes[1], -dy * scale);
  settle();
}

function zoom(by) {
  const distance = eye.distance * Math.exp(by * 0.001);
  eye.center = add(eye.center, eye.axes[2], eye.distance - distance);
  eye.distance = distance;
  settle();
}

const stage = $('stage');
let drag;
stage.addEventListener('pointerdown', (e) => { drag = [e.clientX, e.clientY]; stage.setPointerCapture(e.pointerId); });
stage.addEventListener('pointerup', () => { drag = undefined; });
stage.addEventListener('pointermove', (e) => {
  if (!drag || !eye) return;
  const [dx, dy] = [e.clientX - drag[0], e.clientY - drag[1]];
  drag = [e.clientX, e.clientY];
  (e.buttons & 2 || e.shiftKey ? pan : orbit)(dx, dy);
});
stage.addEventListener('contextmenu', (e) => e.preventDefault());
stage.addEventListener('wheel', (e) => { e.preventDefault(); if (eye) zoom(e.deltaY); }, { passive: false });
$('camera').addEventListener('input', () => eye && from(Number($('camera').value) || 0));
addEventListener('keydown', (e) => {
  if (eye && (e.key === 'n' || e.key === 'p')) from(Number($('camera').value) + (e.key === 'n' ? 1 : -1));
});
addEventListener('resize', touched);

async function picture() {
  const moving = performance.now() - movedAt < 700;
  const fresh = moved !== shown || (state && state.step !== shownStep) || (rough && !moving);
  if (!eye || busy || ended || document.hidden || !fresh) return;
  busy = true;
  const [number, step] = [moved, state ? state.step : -1];
  const room = Math.min(stage.clientWidth, stage.clientHeight / eye.aspect, 960);
  const whole = Math.min(room, 960 / eye.aspect);
  // A picture is followed by a pause in proportion to what it took: a slow device draws small ones, the smaller while moving.
  const pixels = (moving ? 0.04 : 0.12) / Math.max(state?.cost ?? 0, 1e-12);
  const width = Math.max(16, Math.min(whole, Math.max(160, Math.sqrt(pixels / eye.aspect))));
  const size = [width, width * eye.aspect].map((v) => Math.max(16, Math.round(v)));
  const query = `c=${eye.center}&r=${eye.axes.flat()}&f=${eye.focal}&s=${size}`;
  try {
    const answer = await fetch(`picture.jpg?${query}`, { signal: AbortSignal.timeout(60000) });
    if (answer.status === 410) ended = true;
    if (!answer.ok) throw new Error(answer.status);
    const url = URL.createObjectURL(await answer.blob());
    const old = $('picture').src;
    $('picture').src = url;
    await $('picture').decode();
    if (old) URL.revokeObjectURL(old);
    [shown, shownStep, rough] = [number, step, moving && width < whole];
    $('note').textContent = '';
    document.documentElement.dataset.state = 'ready';
  } catch (error) {
    $('note').textContent = ended ? 'training has ended' : 'no picture yet: the trainer is busy';
    await new Promise((resolve) => setTimeout(resolve, 1000));
  }
  busy = false;
}

const clock = (s) => s == null ? '' : s < 90 ? `${s.toFixed(0)} s` : s < 5400 ? `${(s / 60).toFixed(0)} min` : `${(s / 3600).toFixed(1)} h`;

function draw() {
  const canvas = $('curve');
  const ratio = devicePixelRatio || 1;
  const [w, h] = [canvas.clientWidth, canvas.clientHeight];
  [canvas.width, canvas.height] = [w * ratio, h * ratio];
  const c = canvas.getContext('2d');
  c.scale(ratio, ratio);
  const points = state.curve.filter((p) => p[1] > 0);
  if (points.length < 2) return;
  const logs = points.map((p) => Math.log(p[1]));
  const [low, high] = [Math.min(...logs), Math.max(...logs)];
  const x = (step) => 6 + (w - 12) * step / state.iterations;
  const y = (v) => h - 18 - (h - 36) * (v - low) / Math.max(high - low, 1e-9);
  c.strokeStyle = '#6db3f2';
  c.beginPath();
  points.forEach((p, i) => c.lineTo(x(p[0]), y(logs[i])));
  c.stroke();
  c.fillStyle = '#8d95a1';
  c.font = '11px system-ui';
  c.fillText(`loss, logarithmic: ${Math.exp(high).toPrecision(3)} to ${Math.exp(low).toPrecision(3)}`, 6, h - 5);
}

async function status() {
  if (document.hidden || ended) return;
  try {
    state = await (await fetch('state.json', { signal: AbortSignal.timeout(10000) })).json();
  } catch {
    $('note').textContent = 'the trainer does not answer: it has ended, or the connection is gone';
    return;
  }
  ended = state.ended;
  if (ended) $('note').textContent = 'training has ended';
  $('bar').max = state.iterations;
  $('bar').value = state.step;
  const last = state.figures.at(-1);
  const facts = [
    ['step', `${state.step} of ${state.iterations}`],
    ['time left', clock(state.left)],
    ['trained for', clock(state.seconds)],
    ['loss', state.loss.toPrecision(4)],
    ...Object.entries(state.losses).map(([name, value]) => [`– ${name}`, value.toPrecision(3)]),
    ['anchors', state.anchors.toLocaleString('en')],
    ['Gaussians in view', state.gaussians.toLocaleString('en')],
    ...(last ? [['PSNR', `${last[1].toFixed(2)} dB at ${last[0]}`], ...(last[2] == null ? [] : [['in the mask', `${last[2].toFixed(2)} dB`]])] : []),
  ];
  $('facts').replaceChildren(...facts.flatMap((pair) => pair.map((text, i) => {
    const element = document.createElement(i ? 'dd' : 'dt');
    element.textContent = text;
    return element;
  })));
  draw();
}

(async () => {
  scene = await (await fetch('scene.json')).json();
  $('title').textContent = document.title = scene.title;
  $('camera').max = scene.cameras.length - 1;
  from(Math.floor(scene.cameras.length / 2));
  setInterval(picture, 50);
  setInterval(status, 1000);
  status();
})();
