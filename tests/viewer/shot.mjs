// Opens a page of `gscream-vk view` in headless Chromium (WebGL2 in software) and writes pictures of the scene:
// shot.mjs CHROMIUM URL WIDTH HEIGHT OUT [SHARE OUT]... where SHARE is where the slider is put before the next picture.
import { writeFileSync } from 'node:fs';
import puppeteer from 'puppeteer-core';

const [executablePath, url, width, height, first, ...more] = process.argv.slice(2);
const browser = await puppeteer.launch({
  executablePath,
  args: ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist', '--hide-scrollbars'],
});
try {
  const page = await browser.newPage();
  const problems = [];
  page.on('pageerror', (error) => problems.push(error.message));
  page.on('request', (request) => {
    // Nothing is fetched from elsewhere.
    const { protocol, host } = new URL(request.url());
    if (!['data:', 'blob:', 'file:'].includes(protocol) && host !== new URL(url).host) problems.push(request.url());
  });
  // What the page's own policy forbids.
  await page.evaluateOnNewDocument(() => {
    globalThis.violations = [];
    addEventListener('securitypolicyviolation', (event) => globalThis.violations.push(`${event.violatedDirective} ${event.blockedURI}`));
  });
  // The footer takes the rest.
  await page.setViewport({ width: Number(width), height: Number(height) + 60 });
  await page.goto(url);
  await page.waitForFunction(() => document.documentElement.dataset.state, { timeout: 170_000 });
  const state = await page.evaluate(() => document.documentElement.dataset.state);
  if (state !== 'ready') problems.push(await page.evaluate(() => document.getElementById('problem').textContent));
  const shoot = async (out) => {
    // The viewer sorts in a worker and draws when it has: some frames later all is in order.
    await new Promise((resolve) => setTimeout(resolve, 3000));
    writeFileSync(out, await (await page.$('#stage')).screenshot());
  };
  await shoot(first);
  for (let i = 0; i < more.length; i += 2) {
    await page.evaluate((share) => {
      const slider = document.getElementById('slider');
      slider.value = share;
      slider.dispatchEvent(new Event('input'));
    }, more[i]);
    await shoot(more[i + 1]);
  }
  problems.push(...await page.evaluate(() => globalThis.violations));
  if (problems.length) throw new Error(problems.join('; '));
} finally {
  await browser.close();
}
