// The README's picture: the page of `gscream-vk remove` once the object is gone, before and after in one view:
// front.mjs CHROMIUM URL OUT.jpg VIEW, on a folder where everything is made already.
import { visit } from './visit.mjs';

const [chromium, url, path, view] = process.argv.slice(2);
const { browser, page, until, carried, remove, fail } = await visit(chromium, url, '.');
try {
  await carried();
  await remove();
  await page.click('label:has(input[name=look][value=compare])');
  await page.click(`.thumb:has(img[alt="${view}"])`);
  await until(() => !document.getElementById('after').hidden && document.getElementById('after').naturalWidth > 0);
  // All of the strip, too.
  await until(() => [...document.querySelectorAll('.thumb:not([hidden]) img:first-child')].slice(0, 12).every((one) => one.complete && one.naturalWidth > 0));
  await page.mouse.move(1, 1);
  await new Promise((resolve) => setTimeout(resolve, 2000));
  await page.screenshot({ path, type: 'jpeg', quality: 85 });
  await fail();
} finally {
  await browser.close();
}
