'use strict';
const $ = (id) => document.getElementById(id);
const touch = matchMedia('(pointer: coarse)').matches;
const click = touch ? 'tap' : 'click';
const much = touch ? 'with “Not object” on what is too much' : 'with Shift on what is too much';
const stage = $('stage');
const PARTS = {
  poses: 'Finding out where the photographs were taken from',
  fit: 'Learning the shape of the scene',
  shape: 'Measuring how far everything is',
  carry: 'Looking for the object in the other photographs',
  masks: 'Marking the object in every photograph',
  depth: 'Measuring how far everything is',
  reference: 'Finding out what was behind it',
  points: 'Looking for more points',
  train: 'Training the scene without it',
  export: 'Writing the files',
  page: 'Making the page',
};
// What the server says, and what was marked here and is not there yet: marks by object and view.
let state, current, object, sorted = true, order = [];
const waiting = new Map(), sending = new Set();
// How often something was said to the server.
let posted = 0;
// Object, view, and its marks before and after each change.
let past = [], future = [];
// The photograph's place on the stage: zoom is 1 when all of it is shown.
let zoom = 1, shift = [0, 0], cross, corner, corners = [], changing = false;

const view = (name = current) => state?.views.find((v) => v.name === name);
const several = () => state.objects.length > 1;
const placeOf = (number) => state.objects.findIndex((o) => o.number === number);
const named = (number = object) => state.objects[placeOf(number)]?.name;
// The state of a photograph of an object.
const own = (name = current, number = object) => view(name)?.objects[placeOf(number)];
const keyOf = (name, number) => `${number} ${name}`;
const marksOf = (name = current, number = object) => waiting.get(keyOf(name, number)) ?? own(name, number)?.marks ?? [];
const percent = (v) => `${Math.round(100 * v)} %`;
const clock = (s) => s < 90 ? `${Math.max(1, Math.round(s))} s` : s < 5400 ? `${Math.round(s / 60)} min` : `${(s / 3600).toFixed(1)} h`;
const size = (bytes) => bytes > 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.ceil(bytes / 1e3)} kB`;
const url = (path, name, more = '') => `${path}?view=${encodeURIComponent(name)}${more}`;

// ---------------------------------------------------------------- what is said to the server

async function post(path, body) {
  const answer = await fetch(path, {
    method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify(body),
  });
  if (!answer.ok) throw new Error((await answer.text()).trim());
  const said = await answer.json();
  posted += 1;
  take(said);
}

function say(error) {
  $('error').textContent = error;
  $('error').hidden = !error;
}

async function send(name, number) {
  const key = keyOf(name, number);
  if (sending.has(key)) return;
  sending.add(key);
  while (waiting.has(key)) {
    const marks = waiting.get(key);
    try {
      await post('api/marks', { object: number, view: name, marks });
      say('');
    } catch (error) {
      // What was marked before counts, here as well.
      say(`This could not be marked, and nothing was changed: ${error.message}`);
      past = past.filter((change) => change[3] !== marks);
      try {
        take(await (await fetch('api/state')).json());
      } catch { /* The next poll says so. */ }
    }
    if (waiting.get(key) === marks) waiting.delete(key);
  }
  sending.delete(key);
  draw();
}

function mark(marks, name = current, number = object, remember = true) {
  if (!state || state.phase === 'working') return;
  if (remember) {
    past.push([number, name, marksOf(name, number), marks]);
    future = [];
  }
  waiting.set(keyOf(name, number), marks);
  send(name, number);
  draw();
}

const add = (one) => mark([...marksOf(), one]);

// The last click on the object takes a larger or smaller part.
function resize(by) {
  const marks = marksOf(), last = marks.at(-1);
  if (last?.kind !== 'object') return;
  const scale = Math.min(30, Math.max(-30, (last.scale ?? 0) + by));
  mark([...marks.slice(0, -1), scale ? { ...last, scale } : { kind: 'object', at: last.at }]);
}

// The last change of an object that is there.
function last(changes) {
  while (changes.length && placeOf(changes.at(-1)[0]) < 0) changes.pop();
  return changes.pop();
}

function undo() {
  const change = last(past);
  if (change) {
    future.push(change);
    choose(change[0]);
    show(change[1]);
    mark(change[2], change[1], change[0], false);
  } else if (marksOf().length) {
    // Marks of an earlier visit.
    future.push([object, current, marksOf().slice(0, -1), marksOf()]);
    mark(marksOf().slice(0, -1), current, object, false);
  }
}

function redo() {
  const change = last(future);
  if (!change) return;
  past.push(change);
  choose(change[0]);
  show(change[1]);
  mark(change[3], change[1], change[0], false);
}

// ---------------------------------------------------------------- the objects

const rows = new Map();
// The object whose name is being written.
let editing;
// What was ticked when the first tick was changed after a removal: with the same ticks its result is shown again.
let taken;
const ticks = () => state.objects.map((o) => [o.number, o.remove]).join();

const change = (what) => post('api/objects', what).then(() => say(''), (error) => say(error.message));

function choose(number) {
  if (number === object) return;
  object = number;
  corner = undefined;
  corners = [];
  crosshair();
  draw();
}

async function another() {
  const before = state.objects.map((o) => o.number);
  await change({ add: {} });
  const added = state.objects.find((o) => !before.includes(o.number));
  if (!added) return;
  // Its number may have been that of one that is gone.
  [past, future] = [past, future].map((changes) => changes.filter(([number]) => number !== added.number));
  changing = true;
  choose(added.number);
  stage.focus();
}

function rename(number, name) {
  if (editing !== number) return;
  editing = undefined;
  if (name.trim() && name.trim() !== named(number)) change({ rename: { object: number, name } });
  draw();
}

function row({ number }) {
  const item = $('row').content.firstElementChild.cloneNode(true);
  const [tick, radio, text] = item.querySelectorAll('input');
  const [edit, away] = item.querySelectorAll('button');
  tick.onchange = async () => {
    if (!changing) taken = ticks();
    changing = true;
    await change({ tick: { object: number, remove: tick.checked } });
    changing = ticks() !== taken;
    draw();
  };
  radio.onchange = () => choose(number);
  edit.onclick = () => {
    editing = number;
    text.value = named(number);
    draw();
    text.select();
  };
  item.querySelector('label').ondblclick = edit.onclick;
  text.onblur = () => rename(number, text.value);
  text.onkeydown = (e) => {
    if (!['Enter', 'Escape'].includes(e.key)) return;
    // Enter is not that of the button, too.
    e.preventDefault();
    rename(number, e.key === 'Enter' ? text.value : '');
    edit.focus();
  };
  away.onclick = async () => {
    await change({ delete: { object: number } });
    if (placeOf(number) < 0) $('restore').focus();
  };
  return { item, tick, radio, text, edit, away, label: item.querySelector('label') };
}

// Those of the list that go.
const ticked = () => state.objects.filter((o) => o.remove || !several());
const sought = () => ticked().filter((o) => o.marked || [...waiting].some(([key, marks]) => marks.length && key.startsWith(`${o.number} `)));

function drawObjects(working, done, marked) {
  for (const [number, { item }] of rows) {
    if (placeOf(number) >= 0) continue;
    item.remove();
    rows.delete(number);
  }
  state.objects.forEach((o, i) => {
    if (!rows.has(o.number)) rows.set(o.number, row(o));
    const { item, tick, radio, text, edit, away, label } = rows.get(o.number);
    if ($('list').children[i] !== item) $('list').insertBefore(item, $('list').children[i] ?? null);
    item.style.setProperty('--color', o.color);
    item.className = o.number === object && !done ? 'current' : '';
    tick.checked = o.remove;
    radio.checked = o.number === object;
    radio.disabled = done;
    text.hidden = editing !== o.number;
    label.hidden = !text.hidden;
    label.children[2].textContent = label.title = o.name;
    label.children[3].textContent = o.marked ? `${o.marked} marked` : 'not marked';
    for (const [element, what] of [[tick, 'Remove'], [edit, 'Rename'], [away, 'Delete']]) element.setAttribute('aria-label', `${what} ${o.name}`);
    tick.title = `Remove ${o.name}`;
    edit.hidden = away.hidden = done || !text.hidden;
  });
  $('list').hidden = working || !several();
  $('another').hidden = working || done || !(several() || marked);
  $('restore').hidden = working || done || !state.deleted;
  $('deleted').textContent = $('restore').hidden ? '' : `${state.deleted} was deleted.`;
  document.body.style.setProperty('--own', several() ? state.objects[placeOf(object)].color : '#ff503c');
}

$('another').onclick = another;
$('restore').onclick = async () => {
  const before = state.objects.map((o) => o.number);
  await change({ restore: {} });
  const back = state.objects.find((o) => !before.includes(o.number));
  if (!back) return;
  choose(back.number);
  rows.get(back.number).radio.focus();
};

// ---------------------------------------------------------------- the photograph

function place() {
  const v = view();
  if (!v) return;
  const [w, h] = v.size;
  const fits = Math.min(stage.clientWidth / w, stage.clientHeight / h);
  const [width, height] = [w * fits, h * fits];
  const room = [stage.clientWidth - width * zoom, stage.clientHeight - height * zoom];
  shift = shift.map((s, i) => room[i] >= 0 ? room[i] / 2 : Math.min(0, Math.max(room[i], s)));
  const picture = $('picture');
  picture.style.width = `${width}px`;
  picture.style.height = `${height}px`;
  picture.style.setProperty('--zoom', zoom);
  picture.style.transform = `translate(${shift[0]}px, ${shift[1]}px) scale(${zoom})`;
}

function magnify(by, x = stage.clientWidth / 2, y = stage.clientHeight / 2) {
  const next = Math.min(12, Math.max(1, zoom * by));
  shift = [x - (x - shift[0]) * next / zoom, y - (y - shift[1]) * next / zoom];
  zoom = next;
  place();
}

// Where in the photograph, 0 to 1.
function at(event) {
  const box = $('picture').getBoundingClientRect();
  const v = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  return v.map((x) => Math.round(x * 1e5) / 1e5);
}
const within = (p) => p.every((v) => v >= 0 && v <= 1);
const clip = (p) => p.map((v) => Math.min(1, Math.max(0, v)));
const bounds = (a, b) => [Math.min(a[0], b[0]), Math.min(a[1], b[1]), Math.max(a[0], b[0]), Math.max(a[1], b[1])];
const large = (b) => b[2] - b[0] > 0.005 && b[3] - b[1] > 0.005;

function lay(element, [x0, y0, x1, y1]) {
  Object.assign(element.style, { left: `${100 * x0}%`, top: `${100 * y0}%`, width: `${100 * (x1 - x0)}%`, height: `${100 * (y1 - y0)}%` });
}

const mode = () => repaints() ? (takes() ? 'take' : 'brush') : document.querySelector('input[name=mode]:checked').value;
const HINTS = {
  lasso: 'Lasso: drag a rough line around the object. Good for any shape.',
  box: 'Box: drag from corner to corner, closely around the object. Good for what is upright.',
  object: `Object: ${click} on the object, or on what is missing of it. Part − and Part + step from a part to the whole.`,
  background: `Not object: ${click} on what was taken and is not the object.`,
  brush: 'Brush: paint what is missing. It counts exactly as it is painted.',
  erase: 'Erase: paint over what is too much. It counts exactly as it is painted.',
};
// Half of the brush's width, of the photograph's longer side.
const thickness = () => $(repaints() ? 'thickness' : 'radius');
const radius = () => 0.0015 * Math.exp(Number(thickness().value) * 0.04);
const round = (p) => p.map((v) => Math.round(v * 1e4) / 1e4);

// A line of so many corners at most, none nearer to the next than is seen.
function thinned(points, most = 200) {
  const kept = points.filter((p, i) => i === 0 || i === points.length - 1 || Math.hypot(p[0] - points[i - 1][0], p[1] - points[i - 1][1]) > 0);
  const every = Math.ceil(kept.length / most);
  return kept.filter((_, i) => i % every === 0 || i === kept.length - 1).map(round);
}

function line(points, kind, reach = radius()) {
  const path = document.createElementNS('http://www.w3.org/2000/svg', 'path');
  const shut = kind === 'lasso' ? 'Z' : points.length === 1 ? `L${points[0].join(' ')}` : '';
  path.setAttribute('d', `M${points.map((p) => p.join(' ')).join('L')}${shut}`);
  path.setAttribute('class', kind);
  if (kind !== 'lasso') {
    const [w, h] = view().size;
    path.style.strokeWidth = `${2 * reach * $('picture').getBoundingClientRect().width * Math.max(1, h / w)}px`;
  }
  return path;
}

// What is being drawn.
function sketch(points, kind) {
  $('lines').querySelector('.sketch')?.remove();
  if (!points?.length) return;
  const path = line(points, kind);
  path.classList.add('sketch');
  $('lines').append(path);
}

function ring(event) {
  const paints = ['brush', 'erase'].includes(mode()) && event && event.pointerType !== 'touch' && (state?.phase === 'choosing' || repaints());
  $('ring').hidden = !paints;
  if (!paints) return;
  const [w, h] = view().size, [x, y] = at(event);
  const [rx, ry] = [radius() * Math.max(1, h / w), radius() * Math.max(1, w / h)];
  lay($('ring'), [x - rx, y - ry, x + rx, y + ry]);
}
const pointers = new Map();
let drag, pinch;

stage.addEventListener('pointerdown', (e) => {
  if (e.target.closest('#split')) return;
  if (compares() && e.button === 0) {
    stage.focus();
    stage.setPointerCapture(e.pointerId);
    pointers.set(e.pointerId, [e.clientX, e.clientY]);
    divide(at(e)[0]);
  }
  if (state?.phase === 'working' || (state?.phase === 'done' && !changing && !repaints())) return;
  stage.focus();
  stage.setPointerCapture(e.pointerId);
  pointers.set(e.pointerId, [e.clientX, e.clientY]);
  if (pointers.size === 2) {
    drag = undefined;
    $('rubber').hidden = true;
    sketch();
    const [a, b] = [...pointers.values()];
    pinch = { far: Math.hypot(a[0] - b[0], a[1] - b[1]), middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2] };
  } else if (pointers.size === 1) {
    const clicks = ['object', 'background'].includes(mode());
    const pans = e.button === 1 || (e.pointerType === 'touch' && clicks);
    const kind = clicks ? 'box' : repaints() && (e.button === 2 || e.shiftKey) ? 'take' : mode();
    drag = { kind, from: at(e), points: [clip(at(e))], start: [e.clientX, e.clientY], last: [e.clientX, e.clientY], pans, other: e.button === 2 || e.shiftKey, moved: false };
  }
  e.preventDefault();
});
stage.addEventListener('pointermove', (e) => {
  ring(e);
  if (!pointers.has(e.pointerId)) return;
  pointers.set(e.pointerId, [e.clientX, e.clientY]);
  if (compares()) {
    divide(at(e)[0]);
    return;
  }
  if (pinch && pointers.size === 2) {
    const [a, b] = [...pointers.values()];
    const far = Math.hypot(a[0] - b[0], a[1] - b[1]);
    const middle = [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
    const box = stage.getBoundingClientRect();
    shift = [shift[0] + middle[0] - pinch.middle[0], shift[1] + middle[1] - pinch.middle[1]];
    magnify(far / Math.max(1, pinch.far), middle[0] - box.left, middle[1] - box.top);
    pinch = { far, middle };
    return;
  }
  if (!drag) return;
  if (Math.hypot(e.clientX - drag.start[0], e.clientY - drag.start[1]) > 6) drag.moved = true;
  if (!drag.moved) return;
  if (drag.pans) {
    shift = [shift[0] + e.clientX - drag.last[0], shift[1] + e.clientY - drag.last[1]];
    drag.last = [e.clientX, e.clientY];
    place();
  } else if (drag.kind === 'take') takeFrom(drag.from, at(e));
  else if (drag.kind === 'box') {
    $('rubber').hidden = false;
    lay($('rubber'), bounds(clip(drag.from), clip(at(e))));
  } else {
    drag.points.push(clip(at(e)));
    sketch(drag.points, drag.kind);
  }
});
stage.addEventListener('pointerleave', () => ring());
function lifted(e, counts) {
  pointers.delete(e.pointerId);
  if (pinch) {
    if (pointers.size === 0) pinch = undefined;
    return;
  }
  const done = drag;
  drag = undefined;
  $('rubber').hidden = true;
  sketch();
  if (!done || !counts) return;
  if (done.kind === 'take') {
    if (!done.moved && !done.pans) takeFrom(done.from, strokes.length ? middle() : done.from);
    return;
  }
  const paints = ['brush', 'erase'].includes(done.kind) && e.button !== 1;
  if (paints && within(done.from)) stroke(done.kind, done.points);
  else if (done.moved && !done.pans && done.kind === 'box') enclose('box', [done.from, at(e)]);
  else if (done.moved && !done.pans && done.kind === 'lasso') enclose('lasso', done.points);
  else if (!done.moved && within(done.from) && e.button !== 1) {
    const not = (mode() === 'background') !== done.other;
    add({ kind: not ? 'background' : 'object', at: done.from });
  }
}

function stroke(kind, points) {
  (repaints() ? brushed : add)({ kind: 'brush', object: kind === 'brush', radius: Math.round(radius() * 1e5) / 1e5, points: thinned(points) });
}

// What has no inside is nothing.
function enclose(kind, points) {
  const [x, y] = [0, 1].map((i) => points.map((p) => Math.min(1, Math.max(0, p[i]))));
  const around = [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)];
  if (!large(around)) return;
  add(kind === 'box' ? { kind, bounds: around } : { kind, points: thinned(points) });
}
stage.addEventListener('pointerup', (e) => lifted(e, true));
stage.addEventListener('pointercancel', (e) => lifted(e, false));
stage.addEventListener('contextmenu', (e) => e.preventDefault());
stage.addEventListener('wheel', (e) => {
  e.preventDefault();
  if (e.altKey) {
    resize(e.deltaY < 0 ? 1 : -1);
    return;
  }
  const box = stage.getBoundingClientRect();
  magnify(Math.exp(-e.deltaY * 0.0015), e.clientX - box.left, e.clientY - box.top);
}, { passive: false });
new ResizeObserver(place).observe(stage);

$('slider').oninput = () => divide($('slider').value / 100);
divide(0.5);
for (const input of document.querySelectorAll('input[name=look]')) input.onchange = () => draw();

// ---------------------------------------------------------------- keys

function crosshair() {
  $('cross').hidden = !cross;
  if (!cross) return;
  $('cross').style.left = `${100 * cross[0]}%`;
  $('cross').style.top = `${100 * cross[1]}%`;
  sketch(corners.length ? [...corners, cross] : undefined, 'lasso');
  $('rubber').hidden = !corner;
  if (corner) lay($('rubber'), bounds(corner, cross));
}

function step(by) {
  const all = order.filter((name) => offered().includes(name));
  const i = all.indexOf(current);
  if (all.length) show(all[(i + by + all.length) % all.length], true);
}

// Keys that serve to mark and to repaint: whether it was one.
function free(e, arrows) {
  if (arrows && e.shiftKey) {
    const [w, h] = view().size;
    const far = (e.altKey ? 0.002 : 0.02) * Math.max(w, h);
    cross = clip(cross ? cross.map((v, i) => v + arrows[i] * far / (i ? h : w)) : [0.5, 0.5]);
    crosshair();
  } else if (arrows && arrows[0]) step(arrows[0]);
  else if (e.key === '[' || e.key === ']') thickness().value = Number(thickness().value) + (e.key === ']' ? 5 : -5);
  else if (e.key === 'Escape') { cross = corner = drag = undefined; corners = []; $('rubber').hidden = true; crosshair(); }
  else if (e.key === '+' || e.key === '=') magnify(1.4);
  else if (e.key === '-') magnify(1 / 1.4);
  else if (e.key === '0') { zoom = 1; place(); }
  else return false;
  e.preventDefault();
  return true;
}

addEventListener('keydown', (e) => {
  if (!state || e.target.closest?.('input, summary, a')) return;
  const command = e.ctrlKey || e.metaKey;
  const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
  const onButton = e.target.closest?.('button') && !e.target.closest('.thumb');
  if (command && compares()) return;
  if (repaints()) {
    if (paintKey(e, command)) e.preventDefault();
    else if (!command) free(e, arrows);
    return;
  }
  if (command && e.key.toLowerCase() === 'z') (e.shiftKey ? redo : undo)();
  else if (command && e.key.toLowerCase() === 'y') redo();
  else if (command || (compares() && !(arrows?.[0] && !e.shiftKey) && !'+=-0'.includes(e.key))) return;
  else if (free(e, arrows)) return;
  else if (e.key === 'Enter' && cross && !onButton && document.activeElement === stage) add({ kind: e.shiftKey ? 'background' : 'object', at: cross });
  else if ((e.key === 'Backspace' || e.key === 'Delete') && cross) add({ kind: 'background', at: cross });
  else if (e.key.toLowerCase() === 'b' && cross) {
    if (corner) enclose('box', [corner, cross]);
    corner = corner ? undefined : cross;
    crosshair();
  } else if (e.key.toLowerCase() === 'l' && cross) {
    if (e.shiftKey && corners.length > 1) enclose('lasso', [...corners, cross]);
    corners = e.shiftKey ? [] : [...corners, cross];
    crosshair();
  } else if (e.key.toLowerCase() === 'p' && cross) stroke(e.shiftKey ? 'erase' : 'brush', [cross]);
  else if (e.key.toLowerCase() === 'o' && !['working', 'done'].includes(document.body.dataset.phase)) {
    if (e.shiftKey) another();
    else choose(state.objects[(placeOf(object) + 1) % state.objects.length].number);
  } else if (e.key === 'PageUp' || e.key === 'PageDown') resize(e.key === 'PageUp' ? 1 : -1);
  else return;
  e.preventDefault();
});

$('less').onclick = () => resize(-1);
$('more').onclick = () => resize(1);
for (const input of document.querySelectorAll('input[name=mode]')) input.onchange = () => { ring(); draw(); };
$('undo').onclick = undo;
$('redo').onclick = redo;
$('clear').onclick = () => marksOf().length || own()?.origin === 'file' ? mark([]) : undefined;
$('in').onclick = () => magnify(1.4);
$('out').onclick = () => magnify(1 / 1.4);
$('fit').onclick = () => { zoom = 1; place(); };
$('sort').onclick = () => { sorted = !sorted; arrange(); draw(); };
$('next').onclick = () => {
  if (compares()) return show(state.left.view, true);
  if (!state.next) return;
  choose(state.of);
  show(state.next, true);
};
$('again').onclick = () => { changing = true; taken = undefined; draw(); stage.focus(); };
$('remove').onclick = async () => {
  changing = false;
  $('remove').disabled = true;
  try {
    await post('api/remove', { despite: state.problems.length > 0 });
    say('');
  } catch (error) {
    say(error.message);
  }
};
$('stop').onclick = () => post('api/stop', {}).catch((error) => say(error.message));

// ---------------------------------------------------------------- what is shown

const thumbs = new Map();

function thumbnail(v) {
  const button = document.createElement('button');
  button.type = 'button';
  button.className = 'thumb';
  button.style.aspectRatio = `${v.size[0]} / ${v.size[1]}`;
  const picture = new Image();
  picture.loading = 'lazy';
  picture.alt = v.name;
  picture.src = url('thumb.jpg', v.name);
  button.append(picture, document.createElement('em'));
  button.onclick = () => show(v.name);
  return { button, picture, badge: button.lastChild, overlay: undefined, key: undefined };
}

// The order changes when masks were carried anew, not under the user's hands.
function arrange() {
  const rank = (v) => v.doubt ?? -1;
  const views = [...state.views];
  if (sorted) views.sort((a, b) => rank(b) - rank(a));
  order = views.map((v) => v.name);
  const strip = $('strip');
  for (const v of views) {
    if (!thumbs.has(v.name)) thumbs.set(v.name, thumbnail(v));
    strip.append(thumbs.get(v.name).button);
  }
}

function show(name, focus) {
  if (!view(name)) return;
  if (name !== current) {
    current = name;
    unbrush();
    zoom = 1;
    cross = corner = undefined;
    corners = [];
    crosshair();
    $('overlay').hidden = true;
    $('overlay').dataset.key = '';
    place();
  }
  draw();
  if (focus) thumbs.get(name).button.scrollIntoView({ block: 'nearest', inline: 'nearest' });
}

// A new overlay takes the old one's place when it is there.
function overlay(image, source, key) {
  if (image.dataset.key === key) return;
  image.dataset.key = key;
  if (!key) {
    image.hidden = true;
    return;
  }
  const next = new Image();
  next.onload = () => {
    if (image.dataset.key !== key) return;
    image.src = next.src;
    image.hidden = false;
  };
  next.src = source;
}

function draw() {
  if (!state) return;
  const v = view();
  const working = state.phase === 'working', done = state.phase === 'done' && !changing;
  document.body.dataset.phase = done ? 'done' : working ? 'working' : 'choosing';
  const [gone, what] = [ticked().length > 1 ? 'They are gone' : 'It is gone', several() ? 'objects' : 'an object'];
  $('title').textContent = done ? gone : `Remove ${what} from ${state.title}`;
  document.title = `${state.title}: ${done ? gone.toLowerCase() : `remove ${what}`}`;
  const busy = waiting.has(keyOf(current, object)) || v?.busy;
  const look = done && state.compare.length ? document.querySelector('input[name=look]:checked').value : 'around';
  const compared = look === 'compare';
  const drawing = compare(look === 'around' ? '' : look);
  drawRepaint(repaints());
  $('looks').hidden = !done || !state.compare.length;
  const paintBusy = done && state.painting.busy;
  $('thinking').hidden = !(drawing || paintBusy || (busy && !working && !done));
  $('thinking').textContent = paintBusy ? 'repainting' : drawing ? 'drawing it without the object' : 'finding the outline';
  $('name').textContent = several() && !working && !done ? `${named()} in ${current}` : current ?? '';
  $('name').hidden = done && look === 'around';
  if (v) {
    const key = v.overlay ? `${v.name} ${v.overlay}` : '';
    overlay($('overlay'), url('overlay.png', v.name, `&v=${v.overlay}`), working || done ? '' : key);
    const shown = working || done ? [] : marksOf();
    const sketched = $('lines').querySelector('.sketch');
    $('lines').replaceChildren(...shown.filter((m) => m.kind === 'lasso').map((m) => line(m.points, 'lasso')), ...(repaints() ? painted() : []), ...(sketched ? [sketched] : []));
    $('marks').replaceChildren(...shown.filter((m) => m.at || m.bounds).map((m) => {
      const element = document.createElement(m.kind === 'box' ? 'b' : 'i');
      if (m.kind === 'box') lay(element, m.bounds);
      else {
        element.style.left = `${100 * m.at[0]}%`;
        element.style.top = `${100 * m.at[1]}%`;
        if (m.kind === 'background') element.className = 'not';
      }
      return element;
    }));
  }
  $('width').hidden = !['brush', 'erase'].includes(mode());
  $('scale').hidden = !$('width').hidden;
  $('less').disabled = $('more').disabled = marksOf().at(-1)?.kind !== 'object';
  $('hint').textContent = HINTS[mode()];
  $('undo').disabled = !past.length && !marksOf().length;
  $('redo').disabled = !future.length;
  $('clear').disabled = !marksOf().length && own()?.origin !== 'file';

  const marked = state.marked > 0 || waiting.size > 0;
  const goes = sought();
  const empty = marksOf().length && !busy && !(own()?.share > 0);
  drawObjects(working, done, marked);
  const kept = state.objects.filter((o) => o.marked && !ticked().includes(o)).map((o) => o.name);
  const more = kept.length ? ` What is not ticked is still there: tick ${kept.join(' or ')} to remove that as well.` : '';
  const advice = working ? 'You can leave this page open or close it: the work goes on, and this page finds it again.'
    : compared ? 'The photograph is on the left, the scene without the object on the right: drag across the picture or use the slider. Arrow keys and the pictures below show it from elsewhere.' + leftOver()
    : repaints() ? `Where a hole is filled wrong, brush over it and press Repaint: it is filled anew from what is around it, in all photographs. For a patch from elsewhere take “Take from” and drag from there onto it${touch ? '' : ', or hold Shift'}.`
    : done ? `Look around: drag turns, the wheel goes nearer, the slider shows the photograph.${more}`
    : state.problems.length ? 'Something speaks against going on. Mend what is named, or go on anyway.'
    : empty ? `Nothing was found there. Draw a line around the object, or ${click} in the middle of it.`
    : !marked ? `What is to be removed? Draw a rough line around it, or ${click} on it.`
    : several() && !ticked().length ? 'Nothing is ticked: all objects stay. Tick what is to be removed.'
    : several() && !state.objects[placeOf(object)].marked && !marksOf().length ? `Where is ${named()}? Draw a rough line around it, or ${click} on it, in any photograph.`
    : !state.ready ? `Where the outline is wrong, ${click} on what is missing, or ${much}, or paint it. Soon the object will be looked for in the other photographs as well.`
    : state.carrying ? `The ${several() ? 'objects are' : 'object is'} being looked for in the other photographs.`
    : state.next ? `${percent(state.doubt)} of ${several() ? named(state.of) : 'the object'} in ${state.next} is not known from what is marked so far. Draw around it there, too.`
    : `Look through the photographs. Where an outline is wrong, ${click} on what is missing, or ${much}, or paint it.`;
  $('advice').textContent = advice;
  $('next').hidden = compared ? (state.left?.view ?? current) === current
    : working || done || !state.next || state.carrying || (state.next === current && state.of === object);
  $('next').textContent = compared ? `Show ${state.left?.view}` : `Show ${several() ? `${named(state.of)} in ` : ''}${state.next}`;
  $('problems').hidden = working || done || !state.problems.length;
  $('problems').replaceChildren(...state.problems.map((text) => {
    const item = document.createElement('li');
    item.textContent = text;
    return item;
  }));
  if (state.error) say(state.error);
  $('remove').hidden = working || done;
  $('remove').disabled = !goes.length || waiting.size > 0;
  const those = goes.length > 2 ? ` ${goes.length} objects` : several() ? goes.map((o, i) => `${i ? ' and' : ''} ${o.name}`).join('') : '';
  $('remove').textContent = `Remove${those}${state.problems.length ? ' anyway' : ''}`;
  $('remove').classList.add('primary');
  $('stop').hidden = !working;
  $('again').hidden = !done;

  const part = state.part;
  $('progress').hidden = !part || done;
  if (part) {
    $('part').textContent = `${PARTS[part.name] ?? part.name}${left(part)}`;
    if (part.all) [$('bar').max, $('bar').value] = [part.all, part.done];
    else $('bar').removeAttribute('value');
  }
  $('around').hidden = !state.live;
  $('drawn').hidden = !(working && state.live && $('drawn').src);
  const shows = $('viewer').hasAttribute('src');
  if (done && !shows) $('viewer').src = 'result/?noui';
  if (!done && shows) $('viewer').removeAttribute('src');
  $('viewer').hidden = !done || look !== 'around';
  $('files').hidden = !done;
  if (done && $('files').childElementCount !== state.files.length) {
    $('files').replaceChildren(...state.files.map((file) => {
      const link = document.createElement('a');
      link.href = `download/${encodeURIComponent(file.name)}`;
      link.download = `${state.title}-${file.name}`;
      for (const text of [`Download ${file.name.split('.').pop().toUpperCase()}`, size(file.bytes)]) link.append(Object.assign(document.createElement('span'), { textContent: text }));
      return link;
    }));
  }

  $('count').textContent = `${state.views.length} photographs, ${state.marked} marked`;
  for (const o of state.views) {
    const thumb = thumbs.get(o.name);
    thumb.button.setAttribute('aria-current', o.name === current);
    thumb.button.hidden = !offered().includes(o.name);
    const key = o.overlay ?? '';
    if (key !== thumb.key) {
      thumb.key = key;
      if (!thumb.overlay && key) {
        thumb.overlay = new Image();
        thumb.overlay.loading = 'lazy';
        thumb.overlay.alt = '';
        thumb.picture.after(thumb.overlay);
      }
      if (key) thumb.overlay.src = url('overlay.png', o.name, `&small=1&v=${key}`);
      if (thumb.overlay) thumb.overlay.hidden = !key;
    }
    const doubtful = o.doubt != null && o.doubt > 0.15;
    thumb.button.classList.toggle('doubtful', doubtful);
    const dots = several() ? state.objects.filter((_, i) => o.objects[i].origin !== 'none') : [];
    const doubt = doubtful ? `? ${percent(o.doubt)}` : '';
    const words = several() ? doubt : o.marked ? 'marked' : doubt;
    const said = [...dots.map((one) => one.name), words].join(', ');
    if (thumb.said !== said) {
      thumb.said = said;
      thumb.badge.replaceChildren(...dots.map((one) => {
        const dot = document.createElement('i');
        dot.style.setProperty('--color', one.color);
        dot.append(Object.assign(document.createElement('span'), { className: 'unseen', textContent: `${one.name} marked` }));
        return dot;
      }), words);
    }
    thumb.badge.hidden = !dots.length && !words;
  }
}

let began;
function left(part) {
  if (!began || began.name !== part.name || part.done < began.done) began = { name: part.name, done: part.done, time: performance.now() };
  const done = part.done - began.done, took = (performance.now() - began.time) / 1000;
  return part.all && done > 0 && took > 4 ? `, ${clock(took / done * (part.all - part.done))} left` : '';
}

let arranged;
function take(next) {
  const first = !state;
  state = next;
  if (state.phase !== 'done') changing = false;
  const key = state.carrying ? arranged : `${state.revision} ${state.ready} ${state.marked > 0}`;
  if (first || key !== arranged) {
    arranged = key;
    arrange();
  }
  if (placeOf(object) < 0) object = state.objects[0].number;
  if (!current) show(state.views.find((v) => v.marked)?.name ?? state.views[Math.floor(state.views.length / 2)]?.name);
  draw();
  document.documentElement.dataset.revision = state.revision;
}

let lost = false;
async function poll() {
  if (!document.hidden) {
    try {
      const before = posted;
      const answer = await fetch('api/state', { signal: AbortSignal.timeout(15000) });
      const next = await answer.json();
      // What was posted meanwhile is newer.
      if (!sending.size && before === posted) take(next);
      if (lost) say('');
      lost = false;
    } catch {
      lost = true;
      say('gscream-vk does not answer: it has ended, or the connection is gone. The same command opens this page again, with all that was marked.');
    }
  }
  setTimeout(poll, state?.part || state?.carrying ? 500 : 1200);
}

// The scene as it is being trained, from where the photograph was taken.
let cameras;
async function watch() {
  if (!document.hidden && state?.live) {
    try {
      cameras ??= (await (await fetch('live/scene.json')).json()).cameras;
      const camera = cameras.find((c) => c.name === current) ?? cameras[0];
      const width = Math.max(16, Math.round(Math.min(640, 640 / camera.aspect)));
      const sides = [width, Math.max(16, Math.round(width * camera.aspect))];
      const query = `c=${camera.center}&r=${camera.rotation.flat()}&f=${camera.focal}&s=${sides}`;
      const answer = await fetch(`live/picture.jpg?${query}`);
      if (answer.ok) {
        const old = $('drawn').src;
        $('drawn').src = URL.createObjectURL(await answer.blob());
        if (old) URL.revokeObjectURL(old);
        draw();
      }
    } catch { /* The next one may come. */ }
  } else if (!state?.live) {
    cameras = undefined;
    if ($('drawn').src) { URL.revokeObjectURL($('drawn').src); $('drawn').removeAttribute('src'); }
  }
  setTimeout(watch, 1000);
}

setUpRepaint();
poll();
watch();
