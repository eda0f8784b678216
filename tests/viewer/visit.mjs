// Visits a page of `gscream-vk remove` in headless Chromium: what is wrong with it is in `problems`, and pictures of it, in two
// sizes and two schemes, go into the folder `pictures`.
import puppeteer from 'puppeteer-core';

export async function visit(executablePath, url, pictures) {
  const browser = await puppeteer.launch({
    executablePath,
    args: ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist'],
  });
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
        await page.screenshot({ path: `${pictures}/${name}-${size}-${scheme}.png`, fullPage: size === 'phone' });
      }
    }
  };
  const until = (what, timeout = 100_000) => page.waitForFunction(what, { timeout, polling: 200 });
  const server = () => page.evaluate(async () => (await fetch('api/state')).json());
  // A click in the photograph that is shown, 0 to 1, and the mask that comes of it.
  const click = async ([x, y]) => {
    const box = await (await page.$('#picture')).boundingBox();
    await page.mouse.click(box.x + x * box.width, box.y + y * box.height);
    await until(() => document.getElementById('thinking').hidden && !document.getElementById('overlay').hidden);
  };
  // Until the fit is there and the masks are in all other photographs.
  const carried = async () => {
    await page.waitForFunction(async () => {
      const state = await (await fetch('api/state')).json();
      return state.ready && !state.carrying;
    }, { timeout: 100_000, polling: 500 });
    await until(() => !document.querySelector('#progress').checkVisibility());
  };
  // Presses Remove, whatever is found; `meanwhile` while it works.
  const remove = async (meanwhile = () => {}) => {
    await page.click('#remove');
    await until(() => document.body.dataset.phase === 'working');
    await meanwhile();
    await until(() => document.body.dataset.phase === 'done' || !document.getElementById('error').hidden || !document.getElementById('problems').hidden);
    if (await page.evaluate(() => !document.getElementById('problems').hidden)) {
      await shoot('problems');
      await page.click('#remove');
      await until(() => document.body.dataset.phase === 'working');
      await until(() => document.body.dataset.phase !== 'working');
    }
    const error = await page.evaluate(() => document.getElementById('error').textContent);
    if (error) throw new Error(error);
  };
  const fail = async () => {
    problems.push(...await page.evaluate(() => globalThis.violations));
    if (problems.length) throw new Error(problems.join('; '));
  };
  await page.setViewport(sizes.wide);
  await page.goto(url);
  await until(() => document.getElementById('photo').naturalWidth > 0);
  return { browser, page, problems, shoot, until, server, click, carried, remove, fail };
}
