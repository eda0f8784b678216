// Removes an object on the page of `gscream-vk remove` in headless Chromium, as a user would:
// remove.mjs CHROMIUM URL PICTURES X,Y X,Y,... where the positions, 0 to 1, are clicked in the photograph that is shown; what
// it sees goes into the folder PICTURES. Prints JSON: the masks' shares of two photographs, the files' sizes, and pictures of
// two views without the object.
import puppeteer from 'puppeteer-core';

const [executablePath, url, pictures, ...clicks] = process.argv.slice(2);
const browser = await puppeteer.launch({
  executablePath,
  args: ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist'],
});
try {
  const page = await browser.newPage();
  const problems = [];
  page.on('pageerror', (error) => problems.push(error.message));
  page.on('request', (request) => {
    const { protocol, host } = new URL(request.url());
    if (!['data:', 'blob:'].includes(protocol) && host !== new URL(url).host) problems.push(request.url());
  });
  await page.evaluateOnNewDocument(() => {
    globalThis.violations = [];
    addEventListener('securitypolicyviolation', (event) => globalThis.violations.push(`${event.violatedDirective} ${event.blockedURI}`));
  });
  const sizes = { wide: { width: 1280, height: 800 }, phone: { width: 390, height: 844 } };
  const shoot = async (name) => {
    for (const [size, viewport] of Object.entries(sizes).reverse()) {
      await page.setViewport(viewport);
      for (const scheme of ['dark', 'light']) {
        await page.emulateMediaFeatures([{ name: 'prefers-color-scheme', value: scheme }]);
        await new Promise((resolve) => setTimeout(resolve, 300));
        await page.screenshot({ path: `${pictures}/${name}-${size}-${scheme}.png` });
      }
    }
  };
  await page.setViewport(sizes.wide);
  await page.goto(url);
  const until = (what, timeout = 100_000) => page.waitForFunction(what, { timeout, polling: 200 });
  await until(() => document.getElementById('photo').naturalWidth > 0);
  await shoot('open');
  const server = () => page.evaluate(async () => (await fetch('api/state')).json());
  for (const [i, click] of clicks.entries()) {
    const [x, y] = click.split(',').map(Number);
    const box = await (await page.$('#picture')).boundingBox();
    await page.mouse.click(box.x + x * box.width, box.y + y * box.height);
    await until(() => document.getElementById('thinking').hidden && !document.getElementById('overlay').hidden);
    // One by the keys, undone and done again.
    if (i === 0) {
      await page.keyboard.press('b');
      for (const keys of [['z'], ['Shift', 'z']]) {
        await page.keyboard.down('Control');
        for (const key of keys.slice(0, -1)) await page.keyboard.down(key);
        await page.keyboard.press(keys.at(-1));
        for (const key of keys.slice(0, -1)) await page.keyboard.up(key);
        await page.keyboard.up('Control');
        await new Promise((resolve) => setTimeout(resolve, 200));
        await until(() => document.getElementById('thinking').hidden);
      }
    }
  }
  const marked = await page.evaluate(() => document.getElementById('name').textContent);
  // Until the fit is there and the mask is in all other photographs.
  await page.waitForFunction(async () => {
    const state = await (await fetch('api/state')).json();
    return state.ready && !state.carrying;
  }, { timeout: 100_000, polling: 500 });
  await until(() => !document.querySelector('#progress').checkVisibility());
  await shoot('carried');
  const before = await server();
  await page.focus('#stage');
  await page.keyboard.press('ArrowRight');
  await until(() => !document.getElementById('overlay').hidden);
  const other = await page.evaluate(() => document.getElementById('name').textContent);
  await page.click('#remove');
  await until(() => document.body.dataset.phase === 'working');
  await until(() => document.body.dataset.phase === 'done' || !document.getElementById('drawn').hidden || !document.getElementById('error').hidden);
  await shoot('working');
  await until(() => document.body.dataset.phase === 'done' || !document.getElementById('error').hidden || !document.getElementById('problems').hidden);
  if (await page.evaluate(() => !document.getElementById('problems').hidden)) {
    await shoot('problems');
    await page.click('#remove');
    await until(() => document.body.dataset.phase === 'working');
    await until(() => document.body.dataset.phase !== 'working');
  }
  const error = await page.evaluate(() => document.getElementById('error').textContent);
  if (error) throw new Error(error);
  const frame = await (await page.waitForSelector('#viewer:not([hidden])')).contentFrame();
  await frame.waitForFunction(() => document.documentElement.dataset.state, { timeout: 60_000 });
  await new Promise((resolve) => setTimeout(resolve, 1500));
  await shoot('done');
  // Before and after, at two cameras, by the keys and by the mouse.
  const named = () => page.evaluate(() => document.getElementById('name').textContent);
  const split = () => page.evaluate(() => Number(getComputedStyle(document.getElementById('picture')).getPropertyValue('--split')));
  const must = (what, is) => { if (!is) problems.push(`before and after: ${what}`); };
  const compared = [];
  await page.focus('input[name=look]:checked');
  await page.keyboard.press('ArrowRight');
  for (const turn of [0, 1]) {
    const drawn = () => !document.getElementById('after').hidden && document.getElementById('after').naturalWidth > 0;
    await page.waitForFunction(drawn, { timeout: 60_000, polling: 200 });
    if (!turn) await shoot('compare');
    const name = await named();
    compared.push([name, await page.evaluate(async (of) => {
      const bytes = await (await fetch(`after.jpg?view=${encodeURIComponent(of)}`)).arrayBuffer();
      return btoa(String.fromCharCode(...new Uint8Array(bytes)));
    }, name)]);
    await page.focus('#slider');
    const seen = [];
    for (const [key, share] of [['Home', 0], ['End', 100], ['ArrowLeft', 99]]) {
      await page.keyboard.press(key);
      must(`${key} leads to ${await split()}`, await split() === share);
      seen.push(Buffer.from(await (await page.$('#picture')).screenshot()));
    }
    must('the slider changes nothing', !seen[0].equals(seen[1]));
    const box = await (await page.$('#picture')).boundingBox();
    await page.mouse.click(box.x + 0.25 * box.width, box.y + 0.4 * box.height);
    must(`the mouse leads to ${await split()}`, Math.abs(await split() - 25) <= 1);
    await page.focus('#stage');
    await page.keyboard.press('ArrowRight');
    await page.waitForFunction((old) => document.getElementById('name').textContent !== old, { timeout: 10_000 }, name);
  }
  await page.focus('input[name=look]:checked');
  await page.keyboard.press('ArrowLeft');
  await until(() => !document.getElementById('viewer').hidden && document.getElementById('split').hidden);
  const files = await page.evaluate(async () => Promise.all([...document.querySelectorAll('#files a')].map(async (link) => {
    const bytes = await (await fetch(link.href)).arrayBuffer();
    return [link.download, bytes.byteLength];
  })));
  problems.push(...await page.evaluate(() => globalThis.violations));
  if (problems.length) throw new Error(problems.join('; '));
  const share = (name) => before.views.find((view) => view.name === name).share;
  console.log(JSON.stringify({ marked, other, shares: [share(marked), share(other)], files, compared }));
} finally {
  await browser.close();
}
