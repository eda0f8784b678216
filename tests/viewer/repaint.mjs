// Repaints a hole on the page of `gscream-vk remove` where an object is gone, as a user would: in the photograph `name`, at the place
// `at`, 0 to 1, which is in the hole; by the mouse, taken back, and with a patch by the keys. Then the scene is trained with that.
export async function repaint({ page, problems, shoot, until }, name, at) {
  const must = (what, is) => { if (!is) problems.push(`repaint: ${what}`); };
  const bytes = (name) => page.evaluate(async (of) => {
    const all = await (await fetch(`filled.jpg?view=${encodeURIComponent(of)}`)).arrayBuffer();
    return btoa(String.fromCharCode(...new Uint8Array(all)));
  }, name);
  const done = (count) => page.waitForFunction((n) => state.painting.count === n && !state.painting.busy, { timeout: 60_000, polling: 100 }, count);
  const brush = async ([x, y]) => {
    const box = await (await page.$('#picture')).boundingBox();
    await page.mouse.move(box.x + x * box.width, box.y + y * box.height);
    await page.mouse.down();
    await page.mouse.move(box.x + (x + 0.02) * box.width, box.y + y * box.height, { steps: 8 });
    await page.mouse.up();
  };
  await page.focus('input[name=look]:checked');
  await page.keyboard.press('ArrowLeft');
  await page.waitForSelector('#repaint:not([hidden])');
  await page.evaluate((name) => [...document.querySelectorAll('.thumb')].find((thumb) => thumb.querySelector('img').alt === name).click(), name);
  await until(() => document.getElementById('photo').src.includes('filled.jpg') && document.getElementById('photo').complete);
  const other = await page.evaluate((name) => state.filled.at(state.filled.indexOf(name) - 1), name);
  const [before, beside] = [await bytes(name), await bytes(other)];
  must('there is something to repaint', await page.$eval('#paint', (button) => button.disabled));
  await brush([0.01, 0.01]);
  await page.click('#paint');
  await until(() => document.getElementById('error').textContent.includes('beside the hole'));
  await page.click('#unpaint');
  await brush(at);
  must('the error stays', await page.$eval('#error', (error) => error.hidden));
  await shoot('brushed');
  await page.click('#paint');
  await done(1);
  must('nothing has changed', await bytes(name) !== before && await bytes(other) !== beside);
  must('there is no other try', await page.$eval('#paint', (button) => button.textContent) === 'Another try');
  await page.click('#unpaint');
  await done(2);
  must('it is not as before', await bytes(name) === before && await bytes(other) === beside);
  // With a patch from the middle of the photograph, by the keys.
  await brush(at);
  await page.focus('#stage');
  await page.keyboard.down('Shift');
  await page.keyboard.press('ArrowUp');
  await page.keyboard.up('Shift');
  await page.keyboard.press('p');
  await page.keyboard.down('Shift');
  for (let i = 0; i < 9; i += 1) await page.keyboard.press('ArrowRight');
  await page.keyboard.up('Shift');
  await page.keyboard.press('t');
  must('the patch is not shown', await page.$('#lines path.take'));
  await shoot('patch');
  await page.focus('#paint');
  await page.keyboard.press('Enter');
  await done(3);
  must('the patch is not there', await bytes(name) !== before);
  await shoot('repainted');
  await page.click('#train');
  await until(() => document.body.dataset.phase === 'working');
  await until(() => document.body.dataset.phase === 'done');
  must('it is not trained', await page.$eval('#train', (button) => button.hidden));
  await page.focus('input[name=look]:checked');
  await page.keyboard.press('ArrowRight');
  await until(() => !document.getElementById('viewer').hidden);
}
