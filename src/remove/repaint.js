'use strict';
// Repainting by hand, once the object is gone: strokes over what is wrong in the photograph that is shown, and where the patch for them
// lies, from there. What was repainted last can be tried again.
let strokes = [], patch, tried;
const repaints = () => document.body.dataset.look === 'repaint';
const takes = () => document.querySelector('input[name=paint]:checked').value === 'take';

function unbrush() {
  strokes = [];
  patch = tried = undefined;
}

// The middle of what is brushed.
function middle() {
  const points = strokes.flatMap((s) => s.points);
  return [0, 1].map((i) => (Math.min(...points.map((p) => p[i])) + Math.max(...points.map((p) => p[i]))) / 2);
}

function takeFrom(from, to) {
  if (!strokes.length) say('Brush over what is wrong first, then take the patch for it from elsewhere.');
  else patch = round(from.map((v, i) => v - to[i]));
  draw();
}

function brushed(stroke) {
  strokes.push(stroke);
  tried = undefined;
  say('');
  draw();
}

// What is brushed, and the same where its patch lies.
function painted() {
  const moved = (s) => s.points.map((p) => p.map((v, i) => v + patch[i]));
  return strokes.flatMap((s) => [line(s.points, 'brush', s.radius), ...(patch ? [line(moved(s), 'take', s.radius)] : [])]);
}

async function paint(what) {
  try {
    await post('api/repaint', what);
    say('');
  } catch (error) {
    say(error.message);
  }
}

function unpaint() {
  if (patch) patch = undefined;
  else if (strokes.length) strokes.pop();
  else if (state.painting.count && !state.painting.busy) {
    tried = undefined;
    paint({ undo: {} });
  }
  draw();
}

// Whether a key was for the brush.
function paintKey(e, command) {
  const key = e.key.toLowerCase();
  if (command && key === 'z') unpaint();
  else if (command || !cross || !['p', 't'].includes(key)) return false;
  else if (key === 'p') stroke('brush', [cross]);
  else takeFrom(cross, strokes.length ? middle() : cross);
  return true;
}

let painting;
function drawRepaint(on) {
  const { busy, count, untrained, refused } = state.painting;
  if (painting && !busy) {
    // What is there now is seen; the strokes serve for another try.
    if (refused) say(refused);
    else if (painting.strokes) [tried, strokes, patch] = [painting, [], undefined];
  }
  if (painting && !busy) painting = undefined;
  $('repaint').hidden = !on;
  $('paint').textContent = tried ? 'Another try' : 'Repaint';
  $('paint').disabled = busy || !(strokes.length || tried);
  $('unpaint').disabled = busy || !(strokes.length || count);
  $('train').hidden = !untrained;
  $('train').disabled = busy;
}

function setUpRepaint() {
  $('paint').onclick = async () => {
    const what = tried ?? { view: current, strokes, offset: patch ?? null };
    await paint({ paint: what });
    if (state.painting.busy) painting = what;
    draw();
  };
  $('unpaint').onclick = unpaint;
  $('train').onclick = () => post('api/remove', { despite: true }).catch((error) => say(error.message));
}
