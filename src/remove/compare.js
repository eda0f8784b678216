'use strict';
// Before and after, once the object is gone: a photograph and the view without the object, divided by a slider; the strip shows all views
// without it.
const compares = () => document.body.dataset.look === 'compare';

// The part of the picture's width, 0 to 1, that shows the photograph.
function divide(share) {
  $('slider').value = 100 * share;
  $('picture').style.setProperty('--split', $('slider').value);
}

// The view without the object, asked for until it is drawn.
async function fetchAfter(key, source) {
  const image = $('after');
  while (image.dataset.key === key) {
    const answer = await fetch(source).catch(() => undefined);
    const picture = answer?.ok ? await answer.blob() : undefined;
    if (image.dataset.key !== key) return;
    if (picture) {
      URL.revokeObjectURL(image.src);
      image.src = URL.createObjectURL(picture);
      image.dataset.drawn = key;
      draw();
      return;
    }
    if (answer && answer.status !== 503) {
      say(`${current} cannot be drawn without the object.`);
      return;
    }
    await new Promise((resolve) => setTimeout(resolve, 300));
  }
}

// The views that can be shown.
const offered = () => compares() ? state.compare : repaints() ? state.filled : order;

// The removal whose views the thumbnails show without the object; none where they show the photographs.
let thumbed = 0;

// Shows the views without the object in the strip, one after the other as they are drawn.
async function fillStrip(removal) {
  for (const name of state.compare) {
    let answer;
    do {
      if (answer) await new Promise((resolve) => setTimeout(resolve, 300));
      if (thumbed !== removal) return;
      answer = await fetch(url('after.jpg', name, `&small=1&v=${removal}`)).catch(() => undefined);
    } while (answer?.status === 503);
    if (!answer?.ok) continue;
    const picture = await answer.blob();
    if (thumbed !== removal) return;
    thumbs.get(name).picture.src = URL.createObjectURL(picture);
  }
}

// How much of the object is left in the views that were drawn so far.
function leftOver() {
  if (!state.left) return '';
  const share = (part) => percent(Math.max(0, part));
  return ` Of the object ${share(state.left.mean)} is left on average, at most ${share(state.left.most)}, in ${state.left.view}.`;
}

function strip() {
  const wanted = compares() ? state.removals : 0;
  if (wanted === thumbed) return;
  if (thumbed) {
    for (const [name, { picture }] of thumbs) {
      URL.revokeObjectURL(picture.src);
      picture.src = url('thumb.jpg', name);
    }
  }
  thumbed = wanted;
  if (wanted) fillStrip(wanted);
}

function compare(look) {
  const on = look === 'compare';
  document.body.dataset.look = look;
  if (look && !offered().includes(current)) current = order.find((name) => offered().includes(name));
  const image = $('after'), key = on ? `${current} ${state.removals}` : '';
  const source = (path) => url(path, current, `&v=${state.removals}`);
  const filled = () => url('filled.jpg', current, `&v=${state.removals}-${state.painting.count}`);
  const photo = on ? source('before.jpg') : look ? filled() : url('photo.jpg', current);
  if ($('photo').getAttribute('src') !== photo) {
    $('photo').src = photo;
    $('photo').alt = `Photograph ${current}`;
    place();
  }
  if (image.dataset.key !== key) {
    image.dataset.key = key;
    if (key) fetchAfter(key, source('after.jpg'));
  }
  strip();
  const drawn = on && image.dataset.drawn === key;
  image.hidden = $('edge').hidden = !drawn;
  $('split').hidden = !on;
  return on && !drawn;
}
