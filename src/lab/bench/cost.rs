//! What every pass of a step has to do at least, counted from its kernel's source and the step's own numbers.
//!
//! Three things are counted:
//! - **bytes**: every element of every array that the pass needs is read once, and every element that it writes is written
//!   once: what a cache that never forgets would move. Weights and other arrays that all threads read count once.
//! - **operations**: one for each addition, multiplication, fused multiply-add, comparison, selection, minimum, conversion,
//!   division or square root of one component; of integers too where they are what the pass is for (sorts, scans).
//!   Addresses, loops and what padding repeats do not count. What is common to a column of pixels counts per pixel.
//! - **exponentials**: one for each exponential or logarithm, and nothing else for those.
//!
//! To add a pass: a line in [`TABLE`] with its name, its variants, the derivation and the formula; those of the losses
//! stand in the losses' own files. A pass of a step without one fails the tests, and is shown by `bench` without a floor.

use crate::cost::{Counts, Formula, if_so, work};
pub use crate::cost::{Dispatch, Work};
use crate::gpu::form::without_form;
use crate::math::attention::WEIGHTS as ATTENTION_WEIGHTS;
use crate::math::decoder::Layout;
use crate::model::arrays::ARRAYS;
use crate::model::gaussians::{NAMES, widths};
use crate::model::parameter::{PROJECTIONS, WEIGHTS};

impl Dispatch<'_> {
    /// Items of a primitive, by the name of the buffer that its first binding counts them in.
    fn items(&self, c: &Counts) -> f64 {
        match self.buffer(0) {
            "visible_count" => c.visible,
            "slot_count" => c.slots(),
            "drawn_count" => c.drawn,
            "pair_count" => c.pairs,
            // The host's own counts: counters of each tile and run, and the flags of the culling.
            "count" if self.buffer(1) == "run_pairs" => 64.0 * c.tiles,
            "count" => c.anchors,
            _ => f64::NAN,
        }
    }
}

/// Floats of a learnt array, its gradient or its moments; of the decoders those of one head, a third.
fn learnt(c: &Counts, name: &str) -> f64 {
    if let Some(array) = ARRAYS.iter().find(|array| array.names.contain(name)) {
        f64::from((array.width)(c.offsets as u32)) * c.anchors
    } else if let Some(at) = NAMES.iter().position(|names| names.contain(name)) {
        f64::from(widths(c.harmonics as u32)[at]) * c.anchors
    } else if WEIGHTS.contain(name) {
        c.weights()
    } else if PROJECTIONS.contain(name) {
        ATTENTION_WEIGHTS as f64
    } else if name == "losses" {
        8.0
    } else {
        f64::NAN
    }
}

impl Counts {
    /// Gaussian slots: visible anchors times Gaussians per anchor.
    pub fn slots(&self) -> f64 {
        self.visible * self.offsets
    }

    fn weights(&self) -> f64 {
        Layout { offsets: self.offsets as usize }.weights() as f64
    }

    /// Rows of the decoders' second layers, each head's padded to a multiple of 8.
    fn rows(&self) -> f64 {
        [1.0, 3.0, 7.0].into_iter().map(|per| (per * self.offsets / 8.0).ceil() * 8.0).sum()
    }

    /// Bytes of the packed first layer, biases included.
    fn first_bytes(&self) -> f64 {
        16.0 * 960.0
    }

    /// Bytes of the packed second layer and its biases.
    fn second_bytes(&self) -> f64 {
        self.rows() * 33.0 * 4.0
    }

    /// Chunks of anchors over which the decoders' weight gradients are summed.
    fn chunks(&self) -> f64 {
        let anchors = 64.0 * (self.visible / (64.0 * 1024.0)).ceil().max(1.0);
        (self.visible / anchors).ceil()
    }

    /// Rows of tiles that the Gaussians touch, about: as if each touched a square of tiles.
    fn tile_rows(&self) -> f64 {
        (self.drawn * self.pairs).sqrt()
    }

    /// Similarities of the attention: 8 heads, every token of one side with every one of the other.
    fn similarities(&self) -> f64 {
        8.0 * self.tokens * self.tokens
    }
}

/// Gaussians that overlap a pixel are read once for all of it: mean 8, conic 12, opacity 4, colour 12, depth 4 bytes.
fn splat_bytes(with_depth: bool) -> f64 {
    36.0 + 4.0 * if_so(with_depth)
}

/// Every pass of a step but the losses'.
pub const TABLE: &[Formula] = &[
    Formula {
        pass: "fill",
        variants: &[],
        derivation: "the buffer is written",
        work: |_, d| work((d.bytes)(d.buffer(0)), 0.0, 0.0),
    },
    Formula {
        pass: "copy",
        variants: &[],
        derivation: "the smaller of the two buffers is read, and as much written",
        work: |_, d| work(2.0 * (d.bytes)(d.buffer(0)).min((d.bytes)(d.buffer(1))), 0.0, 0.0),
    },
    Formula {
        pass: "primitives/dispatch",
        variants: &[],
        derivation: "a count 4 B; for each dispatch that it sets four words 16 B; 6 operations",
        work: |_, d| work(4.0 + (d.bytes)(d.buffer(1)), 6.0 / 16.0 * (d.bytes)(d.buffer(1)), 0.0),
    },
    Formula {
        pass: "primitives/limit",
        variants: &[],
        derivation: "a count read; count, flag and counter written: 20 B; 3 operations",
        work: |_, _| work(20.0, 3.0, 0.0),
    },
    Formula {
        pass: "primitives/scan_sums",
        variants: &["nonzero"],
        derivation: "per term 4 B and an addition; per block of 1024 a sum 4 B",
        work: |c, d| work(d.items(c) * (4.0 + 4.0 / 1024.0), d.items(c), 0.0),
    },
    Formula {
        pass: "primitives/scan_totals",
        variants: &[],
        derivation: "per block of 1024 terms 8 B and two additions",
        work: |c, d| work(d.items(c) * 8.0 / 1024.0, d.items(c) * 2.0 / 1024.0, 0.0),
    },
    Formula {
        pass: "primitives/scan_spread",
        variants: &[],
        derivation: "per term 8 B and two additions; per block of 1024 its start 4 B",
        work: |c, d| work(d.items(c) * (8.0 + 4.0 / 1024.0), 2.0 * d.items(c), 0.0),
    },
    Formula {
        pass: "primitives/compact",
        variants: &[],
        derivation: "per flag 4 B, a comparison and a bit; per flag set its index 4 B and two operations: anchors in view, Gaussians that exist, or Gaussians drawn",
        work: |c, d| {
            let set = match d.buffer(1) {
                "decoded" => c.gaussians,
                "tiles" => c.drawn,
                _ => c.visible,
            };
            work(4.0 * d.items(c) + 4.0 * set, 2.0 * d.items(c) + 2.0 * set, 0.0)
        },
    },
    Formula {
        pass: "primitives/sort_count",
        variants: &[],
        derivation: "per key 4 B and 6 operations (shift, mask, two for the counter's place, two for the counter)",
        work: |c, d| work(4.0 * d.items(c), 6.0 * d.items(c), 0.0),
    },
    Formula {
        pass: "primitives/sort_scan",
        variants: &[],
        derivation: "a counter per 128 keys (128 digits over blocks of 16384; others have more), read and written: 8 B, 2 operations",
        work: |c, d| work(d.items(c) * 8.0 / 128.0, d.items(c) * 2.0 / 128.0, 0.0),
    },
    Formula {
        pass: "primitives/sort_scatter",
        variants: &["index"],
        derivation: "per key 8 B read (4 where a value is its place), 8 written; counted again 6, placed by 8 operations",
        work: |c, d| work(d.items(c) * if d.is("index") { 12.0 } else { 16.0 }, 14.0 * d.items(c), 0.0),
    },
    Formula {
        pass: "primitives/finite",
        variants: &["gated"],
        derivation: "per float 4 B and 3 operations",
        work: |c, d| work(4.0 * learnt(c, d.buffer(0)), 3.0 * learnt(c, d.buffer(0)), 0.0),
    },
    Formula {
        pass: "render/cull",
        variants: &[],
        derivation: "per anchor position 12, three log-scales 12, flag 4 B; to the camera 21 and in front 8 operations. For one \
                     in view 3 exponentials and 120 operations: perspective 3, lens 20, its Jacobian 24, limits 12, rows 18, \
                     to the world 18, scaled 6, covariance and radius 19",
        work: |c, _| work(28.0 * c.anchors, 29.0 * c.anchors + 120.0 * c.visible, 3.0 * c.visible),
    },
    Formula {
        pass: "render/decode_pack",
        variants: &[],
        derivation: "the weights read, the padded rows written",
        work: |c, _| work(4.0 * c.weights() + c.first_bytes() + c.second_bytes(), 0.0, 0.0),
    },
    Formula {
        pass: "render/decode_input",
        variants: &[],
        derivation: "per visible anchor its number 4, position 12, feature 128, input 160 B; direction and distance 15 operations",
        work: |c, _| work(304.0 * c.visible, 15.0 * c.visible, 0.0),
    },
    Formula {
        pass: "render/decode_hidden",
        variants: &[],
        derivation: "the first layer; per visible anchor input 160, hidden units 384 and their signs 24 B; 96 units of 37 multiply-adds and a maximum",
        work: |c, _| work(c.first_bytes() + 568.0 * c.visible, 96.0 * 38.0 * c.visible, 0.0),
    },
    Formula {
        pass: "render/decode_opacity",
        variants: &[],
        derivation: "the opacities' layer; per visible anchor hidden units 128 B; per slot opacity 4, flag 4 B, 32 multiply-adds, 12 operations and an exponential",
        work: |c, _| work(33.0 * 4.0 * c.offsets + 128.0 * c.visible + 8.0 * c.slots(), 44.0 * c.slots(), c.slots()),
    },
    Formula {
        pass: "render/decode_lists",
        variants: &[],
        derivation: "per Gaussian of an anchor a search in the list: 30 steps of 4 B and 5 operations",
        work: |c, _| work(120.0 * c.offsets, 150.0 * c.offsets, 0.0),
    },
    Formula {
        pass: "render/decode",
        variants: &[],
        derivation: "the second layer; per visible anchor hidden units 256 B; per Gaussian that exists its place in the list 4, the anchor's number 4, position 12, log-scales 24, offset 12 and the Gaussian 56 B (position, colour, scale, rotation, its norm), 10 outputs of 32 multiply-adds, 38 operations (position 6, 6 sigmoids of 2, scale 3, norm 13, rotation 4) and 12 exponentials",
        work: |c, _| {
            let g = c.gaussians;
            work(c.second_bytes() + 256.0 * c.visible + 112.0 * g, (10.0 * 32.0 + 38.0) * g, 12.0 * g)
        },
    },
    Formula {
        pass: "render/activate",
        variants: &[],
        derivation: "per Gaussian position 12, log-scales 12, rotation 16, logit 4, harmonics 12 a coefficient, and position, scale, \
                     rotation, opacity, colour 56 B; 37 operations (position 6, direction 11, rotation 13, opacity 2, colour 5), 9 for each \
                     coefficient (harmonic 3, products 6), 4 exponentials",
        work: |c, _| {
            work((100.0 + 12.0 * c.harmonics) * c.anchors, (37.0 + 9.0 * c.harmonics) * c.anchors, 4.0 * c.anchors)
        },
    },
    Formula {
        pass: "render/activate_backward",
        variants: &[],
        derivation: "per Gaussian drawn its place in the list 4, position 12, scale 12, rotation 16, opacity 4, colour 12, their gradients \
                     56, those of what is learnt 44 and 12 a coefficient; 55 operations (scale 3, rotation 28, opacity 3, colour 10, \
                     direction 11), 6 for each coefficient",
        work: |c, _| work((160.0 + 12.0 * c.harmonics) * c.drawn, (55.0 + 6.0 * c.harmonics) * c.drawn, 0.0),
    },
    Formula {
        pass: "render/widen",
        variants: &[],
        derivation: "per Gaussian that exists its place in the list 4, position 12, scale read and written 24 B; depth 5, three \
                     squares, sums and roots 10 operations",
        work: |c, _| work(40.0 * c.gaussians, 15.0 * c.gaussians, 0.0),
    },
    Formula {
        pass: "render/project",
        variants: &[],
        derivation: "per Gaussian that exists its place in the list 4, position 12, scale 12, rotation 16, mean 8, covariance 12, \
                     depth 4 B and 217 operations: to the camera and in front 24, perspective 5, lens 18, limits 12, Jacobian \
                     24, rows 18, to the world 18, rotation matrix 27, axes 38, narrow variance 21, range 12",
        work: |c, _| work(68.0 * c.gaussians, 217.0 * c.gaussians, 0.0),
    },
    Formula {
        pass: "render/bin_count",
        variants: &[],
        derivation: "per Gaussian that exists its place in the list 4, mean 8, covariance 12, opacity 4, depth 4, conic 12, tiles \
                     4 B, a logarithm and 35 operations (support); per row of tiles 40 (the square root of Gaussians times pairs)",
        work: |c, _| work(48.0 * c.gaussians, 35.0 * c.gaussians + 40.0 * c.tile_rows(), c.gaussians),
    },
    Formula {
        pass: "render/bin_depth_keys",
        variants: &[],
        derivation: "per Gaussian drawn slot 4, depth 4, key 4, value 4 B; 4 operations",
        work: |c, _| work(16.0 * c.drawn, 4.0 * c.drawn, 0.0),
    },
    Formula {
        pass: "render/bin_rank",
        variants: &[],
        derivation: "per Gaussian drawn slot 4, tiles read 4 and written 4 B",
        work: |c, _| work(12.0 * c.drawn, 0.0, 0.0),
    },
    Formula {
        pass: "render/bin_expand",
        variants: &[],
        derivation: "per Gaussian drawn slot 4, first pair 4, tiles 4, mean 8, covariance 12, opacity 4, first pair 4 B, a \
                     logarithm and 35 operations; per row of tiles 40; per pair 8 B and 4 operations",
        work: |c, _| {
            work(40.0 * c.drawn + 8.0 * c.pairs, 35.0 * c.drawn + 40.0 * c.tile_rows() + 4.0 * c.pairs, c.drawn)
        },
    },
    Formula {
        pass: "render/bin_ranges",
        variants: &[],
        derivation: "per pair its tile 4 B and 4 operations; per tile a range 8 B",
        work: |c, _| work(4.0 * c.pairs + 8.0 * c.tiles, 4.0 * c.pairs, 0.0),
    },
    Formula {
        pass: "render/cpu/bin_tally",
        variants: &[],
        derivation: "per pair its tile 4 B and 2 operations; a counter per tile and each of 64 runs read and written: 8 B",
        work: |c, _| work(4.0 * c.pairs + 512.0 * c.tiles, 2.0 * c.pairs, 0.0),
    },
    Formula {
        pass: "render/cpu/bin_tally_ranges",
        variants: &[],
        derivation: "per tile where its first run begins 4, a range 8 B",
        work: |c, _| work(12.0 * c.tiles, 0.0, 0.0),
    },
    Formula {
        pass: "render/cpu/bin_place",
        variants: &[],
        derivation: "per pair its tile 4 and its number 4 B, 2 operations; a counter per tile and each of 64 runs read and written: 8 B",
        work: |c, _| work(8.0 * c.pairs + 512.0 * c.tiles, 2.0 * c.pairs, 0.0),
    },
    Formula {
        pass: "render/rasterize",
        variants: &["color", "depth"],
        derivation: "per tile a range 8, per pair up to the tile's end 8, per Gaussian drawn 36, per pixel rgb 12 B, \
                     and at a cut for every 512 pairs 16 B for each of 256 pixels: 8 a pair; with depth 4 more per Gaussian, 8 per pixel \
                     and 2 per pair. Per sample (pixel and pair up to the tile's end, in rows it reaches) an exponential and 25 \
                     operations: dy 1, across 2, power 6, alpha 2, after 2, decisions 6, weight 2, colour 3, transmittance 1; \
                     with depth 1 more",
        work: |c, d| {
            let depth = if_so(!d.is("color"));
            work(
                8.0 * c.tiles
                    + 8.0 * c.evaluated
                    + splat_bytes(depth > 0.0) * c.drawn
                    + (12.0 + 8.0 * depth) * c.pixels
                    + (8.0 + 2.0 * depth) * c.pairs,
                (25.0 + depth) * c.samples,
                c.samples,
            )
        },
    },
    Formula {
        pass: "render/cpu/rasterize",
        variants: &["color", "depth"],
        derivation: "per tile a range 8 and a count 4, per pair up to the tile's end 8, per pair seen 8, per Gaussian drawn 36, \
                     per pixel rgb 12 B; with depth 4 more per Gaussian and 8 per pixel. Per sample (pixel and pair up to the \
                     tile's end) an exponential and 23 operations: dy 1, across 2, power 5, alpha 2, decision 2, after 2, stop \
                     1, weight 2, colour 3, seen 1, transmittance 2; with depth 1 more",
        work: |c, d| {
            let depth = if_so(!d.is("color"));
            work(
                12.0 * c.tiles
                    + 8.0 * (c.evaluated + c.seen)
                    + splat_bytes(depth > 0.0) * c.drawn
                    + (12.0 + 8.0 * depth) * c.pixels,
                (23.0 + depth) * c.samples,
                c.samples,
            )
        },
    },
    Formula {
        pass: "render/cpu/rasterize_backward",
        variants: &["color", "depth"],
        derivation: "per tile a range 8 and a count 4, per pair seen 8, per Gaussian drawn 36, per pixel rgb 12 and its gradient \
                     12, per pair seen 36 B of gradients, per pair a bit; with depth 4 more per Gaussian and pair seen and 8 \
                     per pixel, with transmittance 8 per pixel. Per sample (pixel and pair seen) an exponential and 39 \
                     operations: sample 18 as forward, product with the colour 3, colour 3, weighted product 1, remainder 1, \
                     gradient of the exponent 2, whether it is one 3, its sum 1, mean 4, conic 3; with depth 2 more; over the \
                     tile's columns 9 (10) additions; per pair 7 more",
        work: |c, d| {
            let depth = if_so(!d.is("color"));
            let transmittance = if_so(!d.is("color") && !d.is("depth"));
            let samples = c.samples * if c.evaluated > 0.0 { c.seen / c.evaluated } else { 0.0 };
            work(
                12.0 * c.tiles
                    + (44.0 + 4.0 * depth) * c.seen
                    + c.pairs / 8.0
                    + splat_bytes(depth > 0.0) * c.drawn
                    + (24.0 + 8.0 * depth + 8.0 * transmittance) * c.pixels,
                (39.0 + 2.0 * depth + (9.0 + depth) / c.tile_side) * samples + 7.0 * c.seen,
                samples,
            )
        },
    },
    Formula {
        pass: "render/rasterize_backward",
        variants: &["color", "depth"],
        derivation: "per tile a range 8, per pair up to the tile's end 8 and behind it 4, per Gaussian drawn 36, per pixel rgb \
                     12 and its gradient 12, per pair 36 B of gradients and 8 of \
                     cuts; with depth 4 more per Gaussian, 6 per pair and 8 per pixel, \
                     with transmittance 8 per pixel. Per sample an exponential and 44 operations: sample 21 as forward, \
                     product with the colour 3, colour 3, remainder 1, gradient of alpha 6, opacity 1, exponent 1, mean 4, \
                     conic 3, transmittance 1; with depth 2 more; and the sum over the tile's columns: 9 (10) additions per \
                     column of a tile's side",
        work: |c, d| {
            let depth = if_so(!d.is("color"));
            let transmittance = if_so(!d.is("color") && !d.is("depth"));
            work(
                8.0 * c.tiles
                    + 8.0 * c.evaluated
                    + 4.0 * (c.pairs - c.evaluated)
                    + splat_bytes(depth > 0.0) * c.drawn
                    + (24.0 + 8.0 * depth + 8.0 * transmittance) * c.pixels
                    + (44.0 + 6.0 * depth) * c.pairs,
                (44.0 + 2.0 * depth + (9.0 + depth) / c.tile_side) * c.samples_back,
                c.samples_back,
            )
        },
    },
    Formula {
        pass: "render/rasterize_gather",
        variants: &["color"],
        derivation: "per Gaussian drawn slot 4, first pair 4, tiles 4, conic 12, gradients 36 B and 4 operations; per pair 36 B and 9 additions; with depth 4 B more per Gaussian and pair and an addition",
        work: |c, d| {
            let depth = if_so(!d.is("color"));
            work(
                (60.0 + 4.0 * depth) * c.drawn + (36.0 + 4.0 * depth) * c.pairs,
                4.0 * c.drawn + (9.0 + depth) * c.pairs,
                0.0,
            )
        },
    },
    Formula {
        pass: "render/rasterize_gather_marked",
        variants: &["color"],
        derivation: "per Gaussian drawn slot 4, first pair 4, tiles 4, conic 12, gradients 36 B and 4 operations; per pair a bit; per pair seen 36 B, 9 additions and 2 for the bit; with depth 4 B more per Gaussian and pair seen and an addition",
        work: |c, d| {
            let depth = if_so(!d.is("color"));
            work(
                (60.0 + 4.0 * depth) * c.drawn + (36.0 + 4.0 * depth) * c.seen + c.pairs / 8.0,
                4.0 * c.drawn + (11.0 + depth) * c.seen,
                0.0,
            )
        },
    },
    Formula {
        pass: "render/compensate",
        variants: &[],
        derivation: "per Gaussian its place in the list 4, covariance 12, opacity 4 and what is drawn of it 4 B; 11 operations",
        work: |c, _| work(24.0 * c.gaussians, 11.0 * c.gaussians, 0.0),
    },
    Formula {
        pass: "render/compensate_backward",
        variants: &[],
        derivation: "per Gaussian drawn its place in the list 4, covariance 12, opacity 4 B, gradients of both, read and written, \
                     32 B; 30 operations",
        work: |c, _| work(52.0 * c.drawn, 30.0 * c.drawn, 0.0),
    },
    Formula {
        pass: "render/project_backward",
        variants: &["color"],
        derivation: "per Gaussian drawn its place in the list 4, position 12, scale 12, rotation 16 and their gradients 40, \
                     gradients of mean 8, covariance 12 and depth 4 B and 430 operations: \
                     forward again 155, residual 23, gradients of u 17, of the scale 18, of the rotation 70, of the Jacobian's \
                     rows 51, of its point 38, of mean and position 58",
        work: |c, d| {
            let depth = if_so(!d.is("color"));
            work((104.0 + 4.0 * depth) * c.drawn, 430.0 * c.drawn, 0.0)
        },
    },
    Formula {
        pass: "render/decode_backward",
        variants: &["fixed_offset", "fixed_scaling", "fixed"],
        derivation: "per visible anchor its number 4, log-scales 24 and their gradient 24 B, 6 exponentials; per slot opacity 4 B; \
                     per Gaussian that exists tiles 4, offset 12 and its gradient 12, the rest of the Gaussian 44, gradients of \
                     its outputs 44 B and 62 operations (offset 9, opacity 3, colour 9, scale 15, rotation 26); per Gaussian \
                     drawn its gradients 56 B",
        work: |c, d| {
            let (offset, scaling) = (!d.is("fixed") || d.is("scaling"), !d.is("fixed") || d.is("offset"));
            work(
                (28.0 + 24.0 * if_so(scaling)) * c.visible
                    + 4.0 * c.slots()
                    + (104.0 + 12.0 * if_so(offset)) * c.gaussians
                    + 56.0 * c.drawn,
                62.0 * c.gaussians,
                6.0 * c.visible,
            )
        },
    },
    Formula {
        pass: "render/decode_backward_hidden",
        variants: &[],
        derivation: "the second layer; per visible anchor 4 B per padded output, signs of the hidden units 24, their gradient 384 B; 11 K outputs times 32 multiply-adds, 192 for the ReLU",
        work: |c, _| {
            work(
                c.second_bytes() + (4.0 * c.rows() + 408.0) * c.visible,
                11.0 * 32.0 * c.slots() + 192.0 * c.visible,
                0.0,
            )
        },
    },
    Formula {
        pass: "render/decode_backward_feature",
        variants: &[],
        derivation: "the first layer; per visible anchor its number 4, gradients of hidden units 384 and feature 128 B; 96 units \
                     times 32 multiply-adds",
        work: |c, _| work(c.first_bytes() + 516.0 * c.visible, 96.0 * 32.0 * c.visible, 0.0),
    },
    Formula {
        pass: "render/decode_backward_first",
        variants: &[],
        derivation: "per visible anchor input 160 and gradients of hidden units 384 B; 96 units times 37 multiply-adds; per chunk \
                     of anchors a first layer written",
        work: |c, _| work(544.0 * c.visible + c.chunks() * c.first_bytes(), 96.0 * 37.0 * c.visible, 0.0),
    },
    Formula {
        pass: "render/cpu/decode_backward_second",
        variants: &[],
        derivation: "one of the three heads, a third of them all; per visible anchor hidden units 384 B; per Gaussian that exists its place in the list 4 B and 44 B of gradients of 11 outputs, times 33; per chunk of 64 a second layer's share of 1452 B written",
        work: |c, _| {
            let bytes = 384.0 * c.visible + (48.0 + 1452.0 / 64.0) * c.gaussians;
            work(bytes / 3.0, 11.0 * 33.0 * c.gaussians / 3.0, 0.0)
        },
    },
    Formula {
        pass: "render/decode_backward_second",
        variants: &[],
        derivation: "per visible anchor hidden units 384 B; per Gaussian that exists its place in the list 4 B and 44 B of gradients of 11 outputs, times 33; per chunk of 64 a second layer's share of 1452 B written",
        work: |c, _| {
            let bytes = 384.0 * c.visible + (48.0 + 1452.0 / 64.0) * c.gaussians;
            work(bytes, 11.0 * 33.0 * c.gaussians, 0.0)
        },
    },
    Formula {
        pass: "render/decode_backward_weights",
        variants: &[],
        derivation: "per chunk of anchors a first layer read and added; its gradient written",
        work: |c, _| {
            let layers = c.chunks() * c.first_bytes();
            work(layers + 4.0 * (c.weights() - 363.0 * c.offsets), layers / 4.0, 0.0)
        },
    },
    Formula {
        pass: "render/decode_backward_weights_second",
        variants: &[],
        derivation: "per chunk of 64 Gaussians that exist a second layer's share of 1452 B read and added; its gradient written",
        work: |c, _| {
            let shares = 1452.0 / 64.0 * c.gaussians;
            work(shares + 4.0 * 363.0 * c.offsets, shares / 4.0, 0.0)
        },
    },
    Formula {
        pass: "model/attention_select",
        variants: &[],
        derivation: "per visible anchor its number 4, position 12, mask 4, key 4, value 4 B and 72 operations (camera 21, in front 8, \
                     lens 25, patch 6, hash 12)",
        work: |c, _| work(28.0 * c.visible, 72.0 * c.visible, 0.0),
    },
    Formula {
        pass: "model/attention_select_take",
        variants: &[],
        derivation: "per token of a side two numbers read and written: 16 B",
        work: |c, _| work(16.0 * c.tokens, 0.0, 0.0),
    },
    Formula {
        pass: "model/attention_blend_gather",
        variants: &[],
        derivation: "per token its number 4, row read 128 and written 128 B; 32 multiplications",
        work: |c, _| work(260.0 * c.tokens, 32.0 * c.tokens, 0.0),
    },
    Formula {
        pass: "model/attention_blend_scatter",
        variants: &[],
        derivation: "per token its number 4, update 128, row read 128 and written 128 B; 64 operations",
        work: |c, _| work(388.0 * c.tokens, 64.0 * c.tokens, 0.0),
    },
    Formula {
        pass: "model/attention_project",
        variants: &[],
        derivation: "both matrices 131072 B; per token features 128, queries and values 4096 B; 2 x 512 x 32 multiply-adds",
        work: |c, _| work(131_072.0 + 4224.0 * c.tokens, 32_768.0 * c.tokens, 0.0),
    },
    Formula {
        pass: "model/attention_forward",
        variants: &[],
        derivation: "per token queries 2048, keys 2048, values 2048, result 2048, softmax 64 B; per similarity (8 heads, own and \
                     other token) 64 + 64 multiply-adds, scale, maximum, difference and sum 4, and an exponential",
        work: |c, _| work(8256.0 * c.tokens, 132.0 * c.similarities(), c.similarities()),
    },
    Formula {
        pass: "model/attention_output",
        variants: &[],
        derivation: "the matrix and bias 65664 B; per token attended values 2048, result 128 B; 512 x 32 multiply-adds",
        work: |c, _| work(65_664.0 + 2176.0 * c.tokens, 16_384.0 * c.tokens, 0.0),
    },
    Formula {
        pass: "model/attention_output_backward",
        variants: &[],
        derivation: "the matrix 65536 B; per token gradient 128, attended values 2048, softmax 64, result 2048, rows 96 B; 512 x 33 \
                     multiply-adds",
        work: |c, _| work(65_536.0 + 4384.0 * c.tokens, 16_896.0 * c.tokens, 0.0),
    },
    Formula {
        pass: "model/attention_backward",
        variants: &[],
        derivation: "per token of both sides queries, values and gradients 6144, rows 96 B, of the own one two results 4096 B; per \
                     similarity three products and two sums of 64 multiply-adds, 10 operations and two exponentials",
        work: |c, _| work(16_576.0 * c.tokens, 330.0 * c.similarities(), 2.0 * c.similarities()),
    },
    Formula {
        pass: "model/cpu/attention_pairs_backward",
        variants: &[],
        derivation: "per token of both sides queries, values and gradients 6144, rows 96 B; per similarity three products of 64 multiply-adds, 10 operations, two exponentials and 12 B",
        work: |c, _| {
            work(12_480.0 * c.tokens + 12.0 * c.similarities(), 202.0 * c.similarities(), 2.0 * c.similarities())
        },
    },
    Formula {
        pass: "model/cpu/attention_pairs_apply",
        variants: &["inside"],
        derivation: "per token of both sides 2048 B; per similarity 4 B and 64 multiply-adds",
        work: |c, _| work(4096.0 * c.tokens + 4.0 * c.similarities(), 64.0 * c.similarities(), 0.0),
    },
    Formula {
        pass: "model/attention_project_backward",
        variants: &[],
        derivation: "both matrices 131072 B; per token two gradients 4096, result 128 B; 2 x 512 x 32 multiply-adds",
        work: |c, _| work(131_072.0 + 4224.0 * c.tokens, 32_768.0 * c.tokens, 0.0),
    },
    Formula {
        pass: "model/attention_weight_backward",
        variants: &[],
        derivation: "per token both factors (512 + 32) x 4 B and 512 x 32 multiply-adds; the matrix written, in 8 slices unless summed at once",
        work: |c, d| {
            let slices = if d.name.contains("/cpu/") { 1.0 } else { 8.0 };
            work(2176.0 * c.tokens + slices * 65_536.0, 16_384.0 * c.tokens, 0.0)
        },
    },
    Formula {
        pass: "model/attention_weight_sum",
        variants: &[],
        derivation: "per weight 8 slices read, the sum written: 36 B and 7 additions",
        work: |_, _| work(36.0 * ATTENTION_WEIGHTS as f64, 7.0 * ATTENTION_WEIGHTS as f64, 0.0),
    },
    Formula {
        pass: "model/attention_skip",
        variants: &[],
        derivation: "three words read, three written: 24 B; 5 operations",
        work: |_, _| work(24.0, 5.0, 0.0),
    },
    Formula {
        pass: "densify/statistics",
        variants: &[],
        derivation: "per slot tiles 4, opacity 4 B, 3 operations; per Gaussian drawn gradient 8, two sums read and written 16 B, 12 \
                     operations; per visible anchor its number 4, two sums 16 B",
        work: |c, _| work(8.0 * c.slots() + 24.0 * c.drawn + 20.0 * c.visible, 3.0 * c.slots() + 12.0 * c.drawn, 0.0),
    },
    Formula {
        pass: "optimizer/adam",
        variants: &[],
        derivation: "per element gradient 4, value and two moments read and written 24 B; 22 operations (the decoders' three heads \
                     are a dispatch each, counted as a third of their weights each)",
        work: |c, d| {
            let share = if d.buffer(1) == "grad_weights" { 1.0 / 3.0 } else { 1.0 };
            let n = share * learnt(c, d.buffer(1));
            work(28.0 * n, 22.0 * n, 0.0)
        },
    },
];

/// What a pass has to do; nothing for one that has no formula.
pub fn of(counts: &Counts, dispatch: &Dispatch<'_>) -> Option<Work> {
    let formula = formula(dispatch.name)?;
    let work = (formula.work)(counts, dispatch);
    // A primitive that counts something which nobody here knows.
    [work.bytes, work.operations, work.exponentials].iter().all(|v| v.is_finite()).then_some(work)
}

/// Every pass of a step.
pub fn all() -> impl Iterator<Item = &'static Formula> {
    TABLE.iter().chain(crate::losses::costs())
}

/// The line of the table for a pass. A form for CPU drivers without a line of its own has the other form's.
pub fn formula(name: &str) -> Option<&'static Formula> {
    let line = |name: &str| {
        all().find(|f| {
            name == f.pass
                || name
                    .strip_prefix(f.pass)
                    .and_then(|rest| rest.strip_prefix('_'))
                    .is_some_and(|variant| f.variants.contains(&variant))
        })
    };
    line(name).or_else(|| line(&without_form(name)))
}
