use serde::{Deserialize, Serialize};

use crate::config::{Invalid, ensure};

/// The form of the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Form {
    /// Anchors with features, from which decoders make Gaussians for each view (Scaffold-GS, GScream).
    #[default]
    Anchors,
    /// Gaussians with colours in spherical harmonics, each learnt by itself (3DGS). Nothing is decoded in a step.
    Gaussians,
}

impl Form {
    /// The word for the model's elements, in the plural.
    pub fn rows(self) -> &'static str {
        match self {
            Self::Anchors => "anchors",
            Self::Gaussians => "Gaussians",
        }
    }
}

/// What is learnt: anchors, their offsets, and the attention between them; or plain Gaussians.
///
/// The feature length (32) and the decoders' hidden width (32) belong to the kernels and are not settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Anchors, or plain Gaussians.
    pub form: Form,
    /// PLY, SPZ, SOG, .splat or GLB file of the plain Gaussians that training begins with, in place of the scene's points; "":
    /// those.
    pub from: String,
    /// So many of the first plain Gaussians stay as they are: the others alone are learnt.
    pub frozen: u32,
    /// Highest degree of the harmonics of plain Gaussians, 0 to 3: 0 shows the same colour from everywhere.
    pub degree: u32,
    /// Edge of the grid to which points are snapped to become anchors, in scene units (Scaffold-GS: 0.001 in general,
    /// GScream: 0.005 for SPIn-NeRF scenes). Zero or less means the median nearest-neighbour distance of the points.
    pub voxel: f64,
    /// Edge in pixels of the training pictures at the median depth of the points, where `voxel` is 0; 0 derives it from
    /// the points' spacing.
    pub voxel_pixels: f64,
    /// Multiplies a voxel that is derived from the points: above 1 for fewer anchors.
    pub voxel_factor: f64,
    /// Gaussians per anchor (Scaffold-GS: 10).
    pub offsets: u32,
    /// The first three features of an anchor begin as the mean colour of its points, from -1 to 1 times this, and its offsets
    /// uniformly in +- half of this, in units of its scaling; 0: all begin as 0 (Scaffold-GS).
    pub color_features: f64,
    /// Opacity that the decoder's last bias gives all Gaussians to begin with; 0: that bias is random as PyTorch's, and
    /// many Gaussians never exist (Scaffold-GS). Plain Gaussians begin with it, too, and with 0.1 where it is 0 (3DGS).
    pub opacity: f64,
    /// Bidirectional cross-attention between anchors inside and around the mask.
    pub attention: Attention,
}

/// Bidirectional cross-attention (GScream, equation 8). It takes part only where a scene has masks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Attention {
    /// Whether attention is trained and applied at all (GScream: true). Off: over five seeds it moved no figure, and a step
    /// takes longer with it (`src/lab/report/README.md`).
    pub enabled: bool,
    /// First step with attention (GScream: 15,000).
    pub start: u32,
    /// Edge of the square patch placed near the mask's bounding box, in pixels of the training image (GScream: 256).
    pub patch: u32,
    /// Most anchors taken from each side of the mask's border (GScream: 2,000).
    pub tokens: u32,
    /// A step goes without attention unless each side has more anchors than this (GScream: 11).
    pub min_tokens: u32,
    /// Share of the attention's output in the blended feature, `f <- blend * attention(f) + (1 - blend) * f` (GScream: 0.03).
    pub blend: f64,
    /// Write the blended features back into the parameters and cut the gradient to them, as GScream's release does,
    /// instead of letting gradients flow through the attention, as the paper says.
    pub write_back: bool,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            form: Form::default(),
            from: String::new(),
            frozen: 0,
            degree: 1,
            voxel: 0.001,
            voxel_pixels: 0.0,
            voxel_factor: 1.0,
            offsets: 10,
            color_features: 0.0,
            opacity: 0.0,
            attention: Attention::default(),
        }
    }
}

impl Default for Attention {
    fn default() -> Self {
        Self {
            enabled: false,
            start: 15_000,
            patch: 256,
            tokens: 2_000,
            min_tokens: 11,
            blend: 0.03,
            write_back: false,
        }
    }
}

impl Config {
    /// Refuses values that no run could use.
    pub fn validate(&self) -> Result<(), Invalid> {
        ensure(self.degree <= 3, "degree", self.degree, "must be between 0 and 3")?;
        let plain = self.form == Form::Gaussians;
        ensure(
            !plain || !self.attention.enabled,
            "attention.enabled",
            self.attention.enabled,
            "model.form is \"gaussians\", which have no features to attend to; set model.attention.enabled=false",
        )
        .map_err(|invalid| invalid.against("form"))?;
        let what = "begins with plain Gaussians; set model.form=gaussians";
        ensure(plain || self.from.is_empty(), "from", &self.from, what).map_err(|invalid| invalid.against("form"))?;
        let what = "keeps plain Gaussians; set model.form=gaussians";
        ensure(plain || self.frozen == 0, "frozen", self.frozen, what).map_err(|invalid| invalid.against("form"))?;
        ensure(self.voxel.is_finite(), "voxel", self.voxel, "must be finite (0 derives it from the points)")?;
        let pixels = self.voxel_pixels;
        ensure((0.0..=1e6).contains(&pixels), "voxel_pixels", pixels, "must be a number of pixels, or 0")?;
        let factor = self.voxel_factor;
        ensure(factor.is_finite() && factor > 0.0, "voxel_factor", factor, "must be positive")?;
        ensure((1..=32).contains(&self.offsets), "offsets", self.offsets, "must be between 1 and 32")?;
        let gain = self.color_features;
        ensure((0.0..=20.0).contains(&gain), "color_features", gain, "must be between 0 and 20")?;
        ensure((0.0..=0.9).contains(&self.opacity), "opacity", self.opacity, "must be between 0 and 0.9")?;
        let attention = &self.attention;
        ensure(attention.patch > 0, "attention.patch", attention.patch, "must be at least 1 pixel")?;
        ensure(
            attention.tokens > attention.min_tokens,
            "attention.tokens",
            attention.tokens,
            format_args!("must be above attention.min_tokens ({})", attention.min_tokens),
        )
        .map_err(|invalid| invalid.against("attention.min_tokens"))?;
        ensure((0.0..=1.0).contains(&attention.blend), "attention.blend", attention.blend, "must be between 0 and 1")
    }
}
