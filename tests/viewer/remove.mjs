// Removes an object on the page of `gscream-vk remove` in headless Chromium, as a user would:
// remove.mjs CHROMIUM URL PICTURES X,Y X,Y,... where the positions, 0 to 1, are clicked in the photograph that is shown; what
// it sees goes into the folder PICTURES. Prints JSON: the masks' shares of two photographs, the files' sizes, and pictures of
// two views without the object.
import { repaint } from './repaint.mjs';
import { visit } from './visit.mjs';

const [chromium, url, pictures, ...clicks] = process.argv.slice(2);
const visited = await visit(chromium, url, pictures);
const { browser, page, problems, shoot, until, server, click, carried, remove, fail } = visited;
try {
  await shoot('open');
  for (const [i, place] of clicks.entries()) {
    await click(place.split(',').map(Number));
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
  await carried();
  await shoot('carried');
  const before = await server();
  await page.focus('#stage');
  await page.keyboard.press('ArrowRight');
  await until(() => !document.getElementById('overlay').hidden);
  const other = await page.evaluate(() => document.getElementById('name').textContent);
  await remove(async () => {
    await until(() => document.body.dataset.phase === 'done' || !document.getElementById('drawn').hidden || !document.getElementById('error').hidden);
    await shoot('working');
  });
  const frame = await (await page.waitForSelector('#viewer:not([hidden])')).contentFrame();
  await frame.waitForFunction(() => document.documentElement.dataset.state, { timeout: 60_000 });
  await new Promise((resolve) => setTimeout(resolve, 1500));
  await shoot('done');
  await repaint(visited, marked, clicks[0].split(',').map(Number));
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
  // The strip shows all views without the object, and the photographs once nothing is compared.
  const strip = (of) => {
    const all = [...document.querySelectorAll('.thumb:not([hidden]) img:first-child')];
    return all.every((one) => one.src.includes(of)) && all[0].naturalWidth > 0;
  };
  await page.waitForFunction(strip, { timeout: 60_000, polling: 200 }, 'blob:');
  await shoot('strip');
  // How much is left of the object, and a way to where that is most.
  await until(() => document.getElementById('advice').textContent.includes('is left on average'));
  const told = await page.evaluate(() => document.getElementById('advice').textContent.match(/at most .* in (.*)\.$/)?.[1]);
  if (await named() !== told) await page.click('#next');
  must(`what is left is most in ${told}, and ${await named()} is shown`, await named() === told);
  await page.focus('input[name=look]:checked');
  await page.keyboard.press('ArrowLeft');
  await until(() => !document.getElementById('viewer').hidden && document.getElementById('split').hidden);
  await page.waitForFunction(strip, { timeout: 60_000, polling: 200 }, 'thumb.jpg');
  const files = await page.evaluate(async () => Promise.all([...document.querySelectorAll('#files a')].map(async (link) => {
    const bytes = await (await fetch(link.href)).arrayBuffer();
    return [link.download, bytes.byteLength];
  })));
  await fail();
  const share = (name) => before.views.find((view) => view.name === name).objects[0].share;
  console.log(JSON.stringify({ marked, other, shares: [share(marked), share(other)], files, compared }));
} finally {
  await browser.close();
}
