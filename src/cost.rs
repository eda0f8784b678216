//! What a pass has to do, as the file of its kernel declares it or the table in [`crate::lab::bench::cost`].

use serde::{Deserialize, Serialize};

use crate::gpu::Access;

/// The step's numbers; means over its views where there are several.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Counts {
    /// Anchors, or plain Gaussians.
    pub anchors: f64,
    /// Coefficients of a plain Gaussian's harmonics for each colour; 0 of anchors.
    #[serde(default)]
    pub harmonics: f64,
    /// Gaussians per anchor.
    pub offsets: f64,
    /// Anchors in view.
    pub visible: f64,
    /// Gaussians of these that exist.
    pub gaussians: f64,
    /// Gaussians that touch a tile.
    pub drawn: f64,
    /// (Gaussian, tile) pairs.
    pub pairs: f64,
    /// Pairs up to where their tile ends: behind the last Gaussian that any of its pixels still sees.
    pub evaluated: f64,
    /// These times the pixels of their tile; of a tile of 16 pixels a side those of its pairs of rows that the Gaussian reaches:
    /// a subgroup of 32 passes over the others.
    pub samples: f64,
    /// Samples of the way back, where a subgroup of 32 has four rows; 0 in records of versions that did not count them.
    #[serde(default)]
    pub samples_back: f64,
    /// Samples that changed a pixel.
    pub blended: f64,
    /// Pairs with such a sample; 0 in records of versions that did not count them.
    #[serde(default)]
    pub seen: f64,
    /// Pixels.
    pub pixels: f64,
    /// Tiles.
    pub tiles: f64,
    /// Side of a tile, pixels.
    pub tile_side: f64,
    /// Tokens of each side of the attention.
    pub tokens: f64,
    /// Scales of the depth gradient.
    pub gradient_scales: f64,
}

impl Counts {
    fn fields(&mut self) -> [&mut f64; 17] {
        let Self {
            anchors,
            harmonics,
            offsets,
            visible,
            gaussians,
            drawn,
            pairs,
            evaluated,
            samples,
            samples_back,
            blended,
            seen,
            pixels,
            tiles,
            tile_side,
            tokens,
            gradient_scales,
        } = self;
        [
            anchors,
            harmonics,
            offsets,
            visible,
            gaussians,
            drawn,
            pairs,
            evaluated,
            samples,
            samples_back,
            blended,
            seen,
            pixels,
            tiles,
            tile_side,
            tokens,
            gradient_scales,
        ]
    }

    /// The mean of some.
    pub fn mean(mut all: Vec<Self>) -> Self {
        let (mut sum, number) = (Self::default(), all.len().max(1) as f64);
        for counts in &mut all {
            for (sum, value) in sum.fields().into_iter().zip(counts.fields()) {
                *sum += *value / number;
            }
        }
        sum
    }
}

/// What a pass has to do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Work {
    /// Bytes read and written.
    pub bytes: f64,
    /// Operations.
    pub operations: f64,
    /// Exponentials and logarithms.
    pub exponentials: f64,
}

impl std::ops::AddAssign for Work {
    fn add_assign(&mut self, other: Self) {
        self.bytes += other.bytes;
        self.operations += other.operations;
        self.exponentials += other.exponentials;
    }
}

/// A pass as it was recorded.
#[derive(Clone, Copy)]
pub struct Dispatch<'a> {
    /// `folder/stem`, or `fill`, `copy`.
    pub name: &'a str,
    /// The buffers' names, in the order of the bindings.
    pub accesses: &'a [(&'static str, Access)],
    /// Bytes of the buffer of such a name.
    pub bytes: &'a dyn Fn(&str) -> f64,
}

impl Dispatch<'_> {
    /// Whether a word is part of the variant's name.
    pub(crate) fn is(&self, word: &str) -> bool {
        self.name.split('_').any(|part| part == word)
    }

    /// The name of the buffer at a binding; nothing where there is none.
    pub(crate) fn buffer(&self, binding: usize) -> &'static str {
        self.accesses.get(binding).map_or("", |(name, _)| *name)
    }
}

/// What one kernel has to do.
#[derive(Debug)]
pub struct Formula {
    /// `folder/stem` of the kernel.
    pub pass: &'static str,
    /// Its variants that the formula is right for as well.
    pub variants: &'static [&'static str],
    /// How the numbers come about.
    pub derivation: &'static str,
    /// The numbers.
    pub work: fn(&Counts, &Dispatch<'_>) -> Work,
}

/// Bytes, operations, exponentials.
pub(crate) fn work(bytes: f64, operations: f64, exponentials: f64) -> Work {
    Work { bytes, operations, exponentials }
}

/// 1 where the pass has it.
pub(crate) fn if_so(yes: bool) -> f64 {
    f64::from(u8::from(yes))
}
