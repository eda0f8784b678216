// Removes two objects on the page of `gscream-vk remove` in headless Chromium, as a user would, the second one first and then both:
// objects.mjs CHROMIUM URL PICTURES MASKS VIEW BOX VIEW BOX where a line is drawn around an object along BOX, X0,Y0,X1,Y1 from 0 to
// 1, in each of the two views. What it sees goes into the folder PICTURES, and so do the masks that the first removal leaves in the folder
// MASKS. Prints JSON: the photographs with the objects' shares of them before either is removed.
import { cpSync } from 'node:fs';
import { visit } from './visit.mjs';

const [chromium, url, pictures, masks, first, onFirst, second, onSecond] = process.argv.slice(2);
const { browser, page, problems, shoot, until, server, carried, remove, fail } = await visit(chromium, url, pictures);
try {
  const must = (what, is) => { if (!is) problems.push(what); };
  const text = (id) => page.evaluate((id) => document.getElementById(id).textContent, id);
  const seen = (selector) => page.evaluate((selector) => !!document.querySelector(selector)?.checkVisibility(), selector);
  const show = async (name) => {
    await page.evaluate((name) => [...document.querySelectorAll('.thumb')].find((thumb) => thumb.querySelector('img').alt === name).click(), name);
    await until(() => document.getElementById('photo').complete);
  };
  const mark = async (words) => {
    const [x0, y0, x1, y1] = words.split(',').map(Number);
    const box = await (await page.$('#picture')).boundingBox();
    const move = ([x, y]) => page.mouse.move(box.x + x * box.width, box.y + y * box.height, { steps: 5 });
    await move([x0, y0]);
    await page.mouse.down();
    for (const corner of [[x1, y0], [x1, y1], [x0, y1]]) await move(corner);
    await page.mouse.up();
    await until(() => document.getElementById('thinking').hidden && document.querySelector('#lines .lasso'));
  };
  const rows = () => page.$$('#list li');
  const named = () => page.evaluate(() => [...document.querySelectorAll('#list li label span')].map((span) => span.textContent));
  const settled = () => page.waitForNetworkIdle({ idleTime: 100, concurrency: 1 }).catch(() => {});

  must('one object has a list', !await seen('#list') && !await seen('#another'));
  await show(first);
  await mark(onFirst);
  must('no other object is offered', await seen('#another') && !await seen('#list'));
  await page.click('#another');
  await until(() => document.querySelectorAll('#list li').length === 2);
  await show(second);
  await mark(onSecond);
  // Another name, by the keys.
  await (await rows())[1].$eval('.rename', (button) => button.focus());
  await page.keyboard.press('Enter');
  await page.keyboard.type('stand');
  await page.keyboard.press('Enter');
  await until(() => document.querySelectorAll('#list li label span')[1].textContent === 'stand');
  must(`names are ${await named()}`, (await named()).join() === 'Object 1,stand');
  must(`it is shown as ${await text('name')}`, await text('name') === `stand in ${second}`);
  await page.focus('#stage');
  await page.keyboard.press('o');
  must(`O leads to ${await text('name')}`, await text('name') === `Object 1 in ${second}`);
  await page.keyboard.press('o');
  await carried();
  await settled();
  await shoot('objects');
  const before = await server();

  // One is deleted and comes back.
  await (await rows())[1].$eval('.delete', (button) => button.click());
  await until(() => document.getElementById('list').hidden && !document.getElementById('restore').hidden);
  must(`Remove says ${await text('remove')}`, await text('remove') === 'Remove');
  await shoot('deleted');
  await page.click('#restore');
  await until(() => document.querySelectorAll('#list li').length === 2 && !document.getElementById('list').hidden);
  await carried();

  // The first one stays in the scene, and goes after all.
  must(`Remove says ${await text('remove')}`, await text('remove') === 'Remove Object 1 and stand');
  await (await (await rows())[0].$('input[type=checkbox]')).click();
  await until(() => document.getElementById('remove').textContent === 'Remove stand');
  await shoot('unticked');
  await remove();
  must(`the title is ${await text('title')}`, await text('title') === 'It is gone');
  cpSync(masks, `${pictures}/masks`, { recursive: true });
  await shoot('one-gone');
  // With the ticks of before the result is there again.
  for (const phase of ['choosing', 'done']) {
    await (await (await rows())[0].$('input[type=checkbox]')).click();
    await page.waitForFunction((phase) => document.body.dataset.phase === phase, {}, phase);
    await settled();
  }
  await (await (await rows())[0].$('input[type=checkbox]')).click();
  await until(() => document.getElementById('remove').textContent === 'Remove Object 1 and stand' && document.getElementById('remove').checkVisibility());
  await remove();
  must(`the title is ${await text('title')}`, await text('title') === 'They are gone');
  await shoot('both-gone');
  await fail();
  console.log(JSON.stringify(Object.fromEntries(before.views.map((view) => [view.name, view.objects.map((one) => one.share)]))));
} finally {
  await browser.close();
}
