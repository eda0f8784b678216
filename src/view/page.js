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
  const viewer = await createViewer({
    container: find('viewer'),
    settings: config.settings,
    contentUrl: await asset('scene.ply', 'application/octet-stream'),
    contentFilename: 'scene.ply',
    renderer: new URLSearchParams(location.search).has('webgl') ? 'webgl' : undefined,
    // Stands still at the training camera instead of circling.
    noanim: true,
    ui: !new URLSearchParams(location.search).has('noui'),
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
