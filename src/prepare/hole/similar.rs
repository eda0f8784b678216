//! The shift under which each patch of a texture is most like the texture itself.

use std::ops::Range;

use rayon::prelude::*;

/// Columns and rows from a pixel to what it copies.
pub type Shift = [isize; 2];
/// Sum of the differences of the channels from which on two pixels are merely different.
pub const DIFFERENT: f32 = 0.6;

/// Patches are `WIDE` pixels wide.
const WIDE: usize = 7;
/// Pixels to each side of a patch's middle.
pub const RADIUS: usize = WIDE / 2;
/// Pixels of a patch whose copies must be known: two thirds.
const ENOUGH: i32 = (2 * WIDE * WIDE).div_ceil(3) as i32;
/// Colours are compared in these parts of one, so that sums may run without rounding.
const PARTS: f32 = 65536.0;
/// [`DIFFERENT`] in those.
const CAPPED: i32 = (DIFFERENT * PARTS + 0.5) as i32;

/// The best shift of each patch.
pub struct Best {
    /// Mean over a patch's pixels of the differences, summed over the channels, at most [`DIFFERENT`] each; infinite where no
    /// shift has enough of them.
    pub error: Vec<f32>,
    /// Number of the shift.
    pub shift: Vec<u32>,
}

impl Best {
    /// Says that no shift is tried yet, for so many patches.
    fn none(patches: usize) -> Self {
        Self { error: vec![f32::INFINITY; patches], shift: vec![u32::MAX; patches] }
    }

    /// Keeps the better of both, of equals the earlier one.
    fn or(mut self, later: &Self) -> Self {
        for at in 0..self.error.len() {
            if later.error[at] < self.error[at] {
                (self.error[at], self.shift[at]) = (later.error[at], later.shift[at]);
            }
        }
        self
    }
}

/// A picture of which not all is known.
#[derive(Clone, Copy)]
pub struct Picture<'a> {
    /// `[pixel]` RGB, 0 to 1.
    pub rgb: &'a [[f32; 3]],
    /// `[pixel]` whether it may be copied.
    pub known: &'a [bool],
    /// Width and height in pixels.
    pub size: [usize; 2],
}

/// Finds for each pixel of a box, row by row, the first of the best shifts of the patch around it. What lies outside the box does
/// not count.
pub fn most_alike(
    Picture { rgb, known, size }: Picture<'_>,
    shifts: &[Shift],
    columns: Range<usize>,
    rows: Range<usize>,
) -> Best {
    let patches = columns.len() * rows.len();
    let whole = |value: f32| (PARTS * value).round() as i32;
    let channels = [0, 1, 2].map(|c| rgb.iter().map(|rgb| whole(rgb[c])).collect::<Vec<i32>>());
    let known = known.iter().map(|known| -i32::from(*known)).collect();
    let search = Search { channels, known, size, columns, rows };
    let chunk = shifts.len().div_ceil(4 * rayon::current_num_threads()).max(1);
    let parts = shifts.par_chunks(chunk).enumerate().map(|(part, shifts)| search.of(shifts, part * chunk));
    parts.collect::<Vec<Best>>().iter().fold(Best::none(patches), Best::or)
}

/// A texture as it is searched: each channel for itself, so that pixels of a row are compared at once.
struct Search {
    channels: [Vec<i32>; 3],
    /// `[pixel]` all bits where it may be copied, none elsewhere.
    known: Vec<i32>,
    size: [usize; 2],
    columns: Range<usize>,
    rows: Range<usize>,
}

/// Sums of differences, in parts of one, and of how many pixels they are: far from what overflows, which is not looked for, so that
/// pixels of a row are compared at once in tests, too.
type Sums = [Vec<i32>; 2];

/// Rows of differences that are kept: those of a patch and the one that left it.
const KEPT: usize = WIDE + 1;

impl Search {
    /// The best of some shifts, the first of which has this number.
    fn of(&self, shifts: &[Shift], first: usize) -> Best {
        let width = self.columns.len();
        let zeros = |n: usize| -> Sums { [vec![0; n], vec![0; n]] };
        let mut best = Best::none(width * self.rows.len());
        let mut compared: [Sums; KEPT] = std::array::from_fn(|_| zeros(width));
        // With a margin of nothing on both sides.
        let (mut down, mut across) = (zeros(width + WIDE), zeros(width));
        for (number, [dx, dy]) in (first as u32..).zip(shifts) {
            // Where both a pixel and its copy are in the picture: a patch around another has not enough of them, nor one of a
            // narrower strip.
            let columns = overlap(&self.columns, self.size[0], *dx);
            let rows = overlap(&self.rows, self.size[1], *dy);
            let (n, m) = (columns.len(), rows.len());
            if n <= RADIUS || m <= RADIUS {
                continue;
            }
            down.iter_mut().for_each(|sums| sums.fill(0));
            // The sums over a patch's rows run: one row comes and one goes.
            for row in 0..m + RADIUS {
                if row >= WIDE {
                    for (sums, gone) in down.iter_mut().zip(&compared[(row - WIDE) % KEPT]) {
                        sums[RADIUS..RADIUS + n]
                            .iter_mut()
                            .zip(gone)
                            .for_each(|(sum, gone)| *sum = sum.wrapping_sub(*gone));
                    }
                }
                if row < m {
                    let here = (rows.start + row) * self.size[0] + columns.start;
                    let there = here.wrapping_add_signed(dy * self.size[0] as isize + dx);
                    let come = &mut compared[row % KEPT];
                    self.compare(here, there, n, come);
                    for (sums, come) in down.iter_mut().zip(come) {
                        sums[RADIUS..RADIUS + n]
                            .iter_mut()
                            .zip(come)
                            .for_each(|(sum, come)| *sum = sum.wrapping_add(*come));
                    }
                }
                let Some(middle) = row.checked_sub(RADIUS) else { continue };
                across.iter_mut().zip(&down).for_each(|(sums, down)| wide(down, &mut sums[..n]));
                let at = (rows.start + middle - self.rows.start) * width + columns.start - self.columns.start;
                keep(&across, number, &mut best.error[at..at + n], &mut best.shift[at..at + n]);
            }
        }
        best
    }

    /// The differences of `n` pixels in a row and their copies.
    fn compare(&self, here: usize, there: usize, n: usize, [sums, counts]: &mut Sums) {
        let channel = |c: usize| (&self.channels[c][here..here + n], &self.channels[c][there..there + n]);
        let ((r, red), (g, green), (b, blue)) = (channel(0), channel(1), channel(2));
        let (own, copy) = (&self.known[here..here + n], &self.known[there..there + n]);
        let (sums, counts) = (&mut sums[..n], &mut counts[..n]);
        for i in 0..n {
            let off = |one: i32, other: i32| one.wrapping_sub(other).wrapping_abs();
            let apart = off(r[i], red[i]).wrapping_add(off(g[i], green[i])).wrapping_add(off(b[i], blue[i]));
            let known = own[i] & copy[i];
            counts[i] = known & 1;
            sums[i] = apart.min(CAPPED) & known;
        }
    }
}

/// The sums over a patch's width, of columns that begin so many before the first patch's middle as it is wide there.
fn wide(columns: &[i32], sums: &mut [i32]) {
    let n = sums.len();
    let by: [&[i32]; WIDE] = std::array::from_fn(|by| &columns[by..by + n]);
    for i in 0..n {
        sums[i] = by.iter().fold(0, |sum: i32, columns| sum.wrapping_add(columns[i]));
    }
}

/// The part of a range of which a shift stays within 0 to `length`.
fn overlap(range: &Range<usize>, length: usize, by: isize) -> Range<usize> {
    let start = range.start.max((-by).max(0) as usize);
    start..range.end.min((length as isize - by).max(0) as usize).max(start)
}

/// Keeps for a row of patches the shift of this number where it is better than what was found before.
fn keep([sums, counts]: &Sums, number: u32, error: &mut [f32], shift: &mut [u32]) {
    let n = error.len();
    let (sums, counts, shift) = (&sums[..n], &counts[..n], &mut shift[..n]);
    for i in 0..n {
        let mean = sums[i] as f32 / (PARTS * counts[i] as f32);
        let found = if counts[i] >= ENOUGH { mean } else { f32::INFINITY };
        let better = found < error[i];
        error[i] = if better { found } else { error[i] };
        shift[i] = if better { number } else { shift[i] };
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_pcg::Pcg64;

    use super::*;

    /// Against each patch and shift by itself, with parts unknown and a box that is not the whole picture.
    #[test]
    fn the_best_of_every_shift_is_found() {
        let mut rng = Pcg64::seed_from_u64(4);
        let size @ [w, h] = [31, 26];
        let mut pixel = |_| {
            let rgb: [f32; 3] = std::array::from_fn(|_| rng.random_range(0..26_000) as f32 / PARTS);
            (rgb, rng.random_bool(0.9))
        };
        let (rgb, source): (Vec<[f32; 3]>, Vec<bool>) = (0..w * h).map(&mut pixel).unzip();
        let texture = Picture { rgb: &rgb, known: &source, size };
        let all = (0..h as isize).flat_map(|dy| (1 - w as isize..w as isize).map(move |dx| [dx, dy]));
        let shifts: Vec<Shift> = all.filter(|[dx, dy]| dx * dx + dy * dy >= 16).collect();
        let (columns, rows) = (3..29, 2..26);
        let found = most_alike(texture, &shifts, columns.clone(), rows.clone());
        let inside = |[x, y]: [isize; 2]| x >= 0 && y >= 0 && x < w as isize && y < h as isize;
        let known =
            |[x, y]: [isize; 2]| inside([x, y]).then(|| y as usize * w + x as usize).filter(|i| texture.known[*i]);
        let error = |[x, y]: [isize; 2], [dx, dy]: Shift| {
            let r = RADIUS as isize;
            let patch = (y - r..=y + r).flat_map(|y| (x - r..=x + r).map(move |x| [x, y]));
            let patch = patch.filter(|[x, y]| columns.contains(&(*x as usize)) && rows.contains(&(*y as usize)));
            let both = patch.filter_map(|[x, y]| Some((known([x, y])?, known([x + dx, y + dy])?)));
            let apart =
                |(a, b): (usize, usize)| (0..3).map(|c| (texture.rgb[a][c] - texture.rgb[b][c]).abs()).sum::<f32>();
            let capped = CAPPED as f32 / PARTS;
            let apart: Vec<f32> = both.map(|pair| apart(pair).min(capped)).collect();
            if apart.len() >= ENOUGH as usize { apart.iter().sum::<f32>() / apart.len() as f32 } else { f32::INFINITY }
        };
        let mut some = 0;
        for (at, (x, y)) in rows.clone().flat_map(|y| columns.clone().map(move |x| (x, y))).enumerate() {
            let errors: Vec<f32> = shifts.iter().map(|shift| error([x as isize, y as isize], *shift)).collect();
            let least = errors.iter().copied().fold(f32::INFINITY, f32::min);
            if least.is_infinite() {
                assert!(found.error[at].is_infinite(), "({x}, {y})");
                continue;
            }
            // The sums are exact, in whole parts below 2^16; the two quotients are rounded, to half a unit in the last place of 1.
            let tolerance = f32::EPSILON;
            assert!((found.error[at] - least).abs() <= tolerance, "({x}, {y}): {} for {least}", found.error[at]);
            assert!(errors[found.shift[at] as usize] - least <= tolerance, "({x}, {y})");
            some += 1;
        }
        assert!(some > 300, "{some}");
    }
}
