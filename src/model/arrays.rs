//! What an anchor has: the list of its learnt arrays, and their values on the host.
//!
//! The list is all that the device's copy ([`super::anchors`]), the files, the checkpoints, growth, pruning and the plan know
//! of an array. The other form of the model has a list of its own: position, log-scales, rotation, opacity and harmonics of
//! static Gaussians ([`super::gaussians`]).

use super::parameter::{Names, names};
use crate::optimizer::Group;

/// Length of an anchor's feature.
pub const FEATURES: usize = 32;

/// The anchors of a scene.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Anchors {
    /// \[anchor\] position, scene units.
    pub position: Vec<[f32; 3]>,
    /// Gaussians per anchor, K.
    pub offsets_per_anchor: usize,
    /// \[anchor\] feature.
    pub feature: Vec<[f32; FEATURES]>,
    /// \[anchor, offset, xyz\] offsets of the Gaussians, in units of the anchor's first three scales.
    pub offset: Vec<f32>,
    /// \[anchor\] log-scales: three for the offsets, three for the Gaussians.
    pub log_scaling: Vec<[f32; 6]>,
}

/// A learnt array with a row for each anchor.
#[derive(Debug)]
pub struct Array {
    /// Of its buffers; the first is the array's name in files and checkpoints.
    pub names: Names,
    /// What `plan` calls its gradient.
    pub gradient: &'static str,
    /// The group whose learning rate it has.
    pub group: Group,
    /// Floats of a row for K Gaussians per anchor.
    pub width: fn(u32) -> u32,
    /// Its values.
    pub get: fn(&Anchors) -> &[f32],
    /// Replaces its values by whole rows.
    pub set: fn(&mut Anchors, Vec<f32>),
    /// What a new anchor begins with; `None`: `grow_append` computes it from the Gaussians that ask for the anchor.
    pub initial: Option<f32>,
    /// Its attributes in a point cloud are `STEM_0..`: under the names of Scaffold-GS where that has the array.
    pub stem: &'static str,
    /// The element of a row that an attribute holds, of K and the attribute's number.
    pub element: fn(usize, usize) -> usize,
}

/// Every learnt array of the anchors. The first three are those of Scaffold-GS.
pub static ARRAYS: [Array; 3] = [
    Array {
        names: names!("feature"),
        gradient: "gradient of features",
        group: Group::Feature,
        width: |_| FEATURES as u32,
        get: |anchors| anchors.feature.as_flattened(),
        set: |anchors, values| anchors.feature = values.as_chunks().0.to_vec(),
        initial: None,
        stem: "f_anchor_feat",
        element: |_, column| column,
    },
    Array {
        names: names!("offset"),
        gradient: "gradient of offsets",
        group: Group::Offset,
        width: |offsets| 3 * offsets,
        get: |anchors| &anchors.offset,
        set: |anchors, values| anchors.offset = values,
        initial: Some(0.0),
        stem: "f_offset",
        // Such files hold the (K, 3) offsets transposed to (3, K).
        element: |offsets, column| 3 * (column % offsets) + column / offsets,
    },
    Array {
        names: names!("log_scaling"),
        gradient: "gradient of log-scales",
        group: Group::LogScaling,
        width: |_| 6,
        get: |anchors| anchors.log_scaling.as_flattened(),
        set: |anchors, values| anchors.log_scaling = values.as_chunks().0.to_vec(),
        initial: None,
        stem: "scale",
        element: |_, column| column,
    },
];

impl Anchors {
    /// Anchors with these arrays; any other begins with its initial value.
    pub fn new(
        offsets_per_anchor: usize,
        position: Vec<[f32; 3]>,
        feature: Vec<[f32; FEATURES]>,
        offset: Vec<f32>,
        log_scaling: Vec<[f32; 6]>,
    ) -> Self {
        Self { position, offsets_per_anchor, feature, offset, log_scaling }.completed()
    }

    /// The same, where arrays that have an initial value and are shorter than the positions go on with it.
    pub fn completed(mut self) -> Self {
        for array in &ARRAYS {
            let len = self.position.len() * self.width(array);
            let values = (array.get)(&self);
            if let Some(initial) = array.initial.filter(|_| values.len() < len) {
                let mut values = values.to_vec();
                values.resize(len, initial);
                (array.set)(&mut self, values);
            }
        }
        self
    }

    /// Floats of a row of an array.
    pub fn width(&self, array: &Array) -> usize {
        (array.width)(self.offsets_per_anchor as u32) as usize
    }
}
