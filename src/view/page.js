const find = (id) => document.getElementById(id);
const config = JSON.parse(find('config').textContent);
const stage = find('stage'), slider = find('slider'), photograph = find('photograph'), edge = find('edge');
document.title = config.title;
find('after').textContent = config.title;
stage.style.setProperty('--aspect', config.aspect);

const fail = (error) => {
  find('problem').hidden = false;
  find('problem').textContent = `The scene cannot be shown: ${error?.message ?? error}`;
  document.documentElement.dataset.state = 'failed';
};

// What lies in the page itself is gzip in base64; what a server has is fetched.
const asset = async (name, type) => {
  const inline = find(`asset-${name}`);
  if (!inline) return new URL(name, location.href).href;
  const bytes = Uint8Array.from(atob(inline.textContent.trim()), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
  inline.remove();
  return URL.createObjectURL(new Blob([await new Response(stream).blob()], { type }));
};

// The colours of the PLY's Gaussians, drawn to red by how much of them is guessed. Degree 0 alone is changed: the rest is faint.
const tinted = (ply, guessed) => {
  const bytes = new Uint8Array(ply);
  const text = new TextDecoder().decode(bytes.subarray(0, 8192));
  const end = text.indexOf('end_header\n') + 'end_header\n'.length;
  const names = [...text.slice(0, end).matchAll(/^property float (\S+)$/gm)].map((match) => match[1]);
  const values = new DataView(ply, end);
  const red = [0.95, 0.2, 0.1].map((color) => (color - 0.5) / 0.28209479177387814);
  const places = red.map((_, c) => names.indexOf(`f_dc_${c}`));
  guessed.forEach((part, row) => places.forEach((place, c) => {
    const at = 4 * (row * names.length + place);
    const share = 0.75 * part / 255;
    values.setFloat32(at, (1 - share) * values.getFloat32(at, true) + share * red[c], true);
  }));
  return URL.createObjectURL(new Blob([bytes]));
};

const show = (share) => {
  stage.style.setProperty('--share', share);
  photograph.hidden = edge.hidden = share <= 0;
};

try {
  const style = document.createElement('link');
  style.rel = 'stylesheet';
  style.href = await asset('viewer.css', 'text/css');
  document.head.append(style);
  const { createViewer } = await import(await asset('viewer.js', 'text/javascript'));
  let scene = await asset('scene.ply', 'application/octet-stream');
  const query = new URLSearchParams(location.search), tint = find('tint').querySelector('input');
  tint.checked = location.hash === '#tint';
  find('tint').hidden = !config.guessed;
  if (config.guessed && tint.checked) {
    const [ply, guessed] = await Promise.all([scene, await asset('guessed.bin')].map(async (url) => (await fetch(url)).arrayBuffer()));
    scene = tinted(ply, new Uint8Array(guessed));
  }
  tint.addEventListener('change', () => {
    location.hash = tint.checked ? 'tint' : '';
    location.reload();
  });
  const viewer = await createViewer({
    container: find('viewer'),
    settings: config.settings,
    contentUrl: scene,
    contentFilename: 'scene.ply',
    renderer: query.has('webgl') ? 'webgl' : undefined,
    // Stands still at the training camera instead of circling.
    noanim: true,
    ui: !query.has('noui'),
  });
  const ready = () => {
    viewer.state.cameraMode = 'orbit';
    document.documentElement.dataset.state = 'ready';
  };
  if (viewer.state.loaded) ready(); else viewer.events.once('loaded:changed', ready);
  if (config.photograph) {
    photograph.src = await asset('photograph.jpg', 'image/jpeg');
    slider.addEventListener('input', () => {
      // The photograph fits the camera that it was taken with.
      if (photograph.hidden && viewer.state.loaded) viewer.resetCamera();
      show(Number(slider.value));
    });
    const moved = () => { slider.value = 0; show(0); };
    for (const event of ['pointerdown', 'wheel']) find('viewer').addEventListener(event, moved, { passive: true });
  } else {
    find('before').hidden = slider.hidden = true;
  }
} catch (error) {
  fail(error);
}
