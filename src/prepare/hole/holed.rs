//! Pictures with a hole.

use super::similar::{Picture, Shift};

/// A picture with a hole.
#[derive(Clone, Debug)]
pub struct Texture {
    /// Width and height in pixels.
    pub size: [usize; 2],
    /// `[pixel]` RGB, 0 to 1; in the hole anything.
    pub rgb: Vec<[f32; 3]>,
    /// `[pixel]` whether it is to be filled; no more once it is.
    pub hole: Vec<bool>,
    /// `[pixel]` whether it may be copied; never in the hole.
    pub source: Vec<bool>,
}

impl Texture {
    pub fn picture(&self) -> Picture<'_> {
        Picture { rgb: &self.rgb, known: &self.source, size: self.size }
    }

    /// The pixel at a shift from another, if it is in the picture.
    pub fn shifted(&self, pixel: usize, [dx, dy]: Shift) -> Option<usize> {
        let [w, h] = self.size.map(|n| n as isize);
        let (x, y) = (pixel as isize % w + dx, pixel as isize / w + dy);
        (x >= 0 && y >= 0 && x < w && y < h).then(|| (y * w + x) as usize)
    }

    /// The pixel at a shift, if it may be copied.
    pub fn source(&self, pixel: usize, shift: Shift) -> Option<usize> {
        self.shifted(pixel, shift).filter(|at| self.source[*at])
    }

    /// Reduced by a whole factor: means of what is known, hole where any of its pixels is.
    pub fn reduced(&self, by: usize) -> Self {
        let size @ [w, h] = self.size.map(|n| n.div_ceil(by));
        let mut small = Self { size, rgb: vec![[0.0; 3]; w * h], hole: vec![false; w * h], source: vec![false; w * h] };
        for (at, rgb) in small.rgb.iter_mut().enumerate() {
            let (x0, y0) = (at % w * by, at / w * by);
            let rows = y0..(y0 + by).min(self.size[1]);
            let pixels: Vec<usize> =
                rows.flat_map(|y| (x0..(x0 + by).min(self.size[0])).map(move |x| y * self.size[0] + x)).collect();
            small.hole[at] = pixels.iter().any(|i| self.hole[*i]);
            small.source[at] = pixels.iter().all(|i| self.source[*i]);
            let known: Vec<usize> = pixels.iter().copied().filter(|i| !self.hole[*i]).collect();
            let count = known.len().max(1) as f32;
            *rgb = std::array::from_fn(|c| known.iter().map(|i| self.rgb[*i][c]).sum::<f32>() / count);
        }
        small
    }

    /// The mean of what is known so near a pixel, to each side; NaN where nothing is.
    pub fn mean_within(&self, pixel: usize, reach: usize) -> [f32; 3] {
        let [w, h] = self.size;
        let (x, y) = (pixel % w, pixel / w);
        let rows = y.saturating_sub(reach)..(y + reach + 1).min(h);
        let near = rows.flat_map(|v| (x.saturating_sub(reach)..(x + reach + 1).min(w)).map(move |u| v * w + u));
        let (mut sum, mut n) = ([0f32; 3], 0f32);
        for j in near.filter(|j| self.source[*j]) {
            (0..3).for_each(|c| sum[c] += self.rgb[j][c]);
            n += 1.0;
        }
        sum.map(|sum| sum / n)
    }
}
