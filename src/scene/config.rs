use serde::{Deserialize, Serialize};

use crate::config::{Invalid, ensure};

/// How a scene is read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default, expecting = "a table")]
pub struct Config {
    /// Train at 1 / `downscale` of the pictures' size, each side rounded to the nearest pixel. At least 1.
    pub downscale: u32,
    /// Masks are 0 on the object instead of off it.
    pub invert_masks: bool,
    /// Enlarge the train masks by a disc of this radius, in pixels at the training size, at most 1,024. Test masks stay as
    /// they are.
    pub dilate_masks: u32,
    /// Where the layout has no test views, hold out the first of every `test_every` views; 0 holds out none. Held-out
    /// views show the object, so they judge the scene around it.
    pub test_every: u32,
    /// Names of views that are neither trained on nor tested. Views whose photographs agree with the others' nowhere, for
    /// the model has their cameras in a wrong place, are added by `dense`.
    pub leave_out: Vec<String>,
    /// Use the train masks; `false` trains on every pixel, the object included. Without masks there is no reference either.
    pub masks: bool,
    /// Take the object's shadow out of the photographs, where `prepare` has found it (`relight/`).
    pub relight: bool,
    /// Train the other views on their holes as `prepare` has filled them (`hole/`), instead of on nothing there (GScream: off).
    pub fill_holes: bool,
    /// Length of the model's that counts as one wherever a setting means a length; 0 takes a third of the median depth of
    /// the points, so that the unit of the capture changes nothing (GScream: 1).
    pub unit: f64,
    /// Divide each photograph by its exposure and white balance over the others', by what they show of the same points, where
    /// these differ (GScream: off).
    pub even_exposures: bool,
    /// Hold each prior against the points of the model: one that does not follow them is not used, disparity is turned into
    /// depth, and a reference picture without prior gets a guess from the points around its hole. The reference's prior has
    /// its depth from the points, once; `false` fits the rendered depth to it in every step (GScream, equation 4). Rendered
    /// depth is nearer than the surface where something thin hangs in front of it, and a fit hands that error on to the hole.
    pub check_priors: bool,
    /// Leave out the points that stand on the object, and add points in the hole, at the depth of the reference's prior, and
    /// behind its depth edges, where other train cameras see what neither the reference nor any photograph shows (GScream:
    /// off).
    pub seed_hole: bool,
    /// Add points where the photographs agree on a depth and the model has none, and on planes around what stays unknown:
    /// floors, walls and what is far off get anchors, too. A view in which hardly anything agrees with the others is left
    /// out (GScream: off).
    pub dense: bool,
    /// Let the train masks fall off over so many pixels around the object, at the training size: its antialiased edge and
    /// shadow reach beyond the mask. 0: masks are hard (GScream).
    pub rim: u32,
    /// Hold the pixels around the train masks against the other views: what disagrees with them and hangs together with the
    /// mask counts less, or not at all. Masks that are too tight, reflections (GScream: off).
    pub judge_rim: bool,
    /// Let the inpainted picture count everywhere alike (GScream). Otherwise the photograph takes its place outside its hole,
    /// and in the hole other views that see past the object outrank it.
    pub whole_reference: bool,
    /// Name of a test view, which shows the place without the object, to train on as the reference in place of the
    /// delivered one: what was inpainted is then the truth. Its hole is its test mask. Empty for the delivered reference.
    pub truth_reference: String,
    /// Depth prior of that view: a file, in the scene's folder unless the path is absolute. Empty for the one under the
    /// view's name among the scene's priors, or its true depth, if there is one; `none` for no prior; `stereo` for depth
    /// measured over the other test views, by [`condition`](super::condition).
    pub truth_prior: String,
    /// Depth priors in place of the scene's own: a folder, in the scene's unless the path is absolute. Its name says
    /// `disparity`, or it is depth; `reference/` in it has the inpainted picture's. Empty for the scene's own, `none` for
    /// none.
    pub prior_folder: String,
    /// Inpainted picture in place of the delivered one: a file, in the scene's folder unless the path is absolute. It is
    /// that of the train view whose name it has, or of the delivered picture's view. Empty for the delivered one, `none` for
    /// no reference view.
    pub reference_file: String,
}

impl Config {
    /// Whether the scene's reference view takes part.
    pub(super) fn has_reference(&self) -> bool {
        self.masks && self.reference_file != NONE
    }

    /// Refuses values that no scene could be read with.
    pub fn validate(&self) -> Result<(), Invalid> {
        ensure(self.downscale > 0, "downscale", self.downscale, "must be at least 1")?;
        let most = MOST_DILATION;
        ensure(self.dilate_masks <= most, "dilate_masks", self.dilate_masks, format!("must be at most {most} pixels"))?;
        let unit = self.unit;
        ensure(
            unit == 0.0 || (1e-30..=1e30).contains(&unit),
            "unit",
            unit,
            "must be a positive length, or 0 to find it",
        )?;
        ensure(self.rim <= 64, "rim", self.rim, "must be at most 64 pixels")
    }
}

/// Largest [`Config::dilate_masks`]: a mask that needs more is none of the object.
const MOST_DILATION: u32 = 1024;

/// What a setting of files says for leaving out what they would hold: [`Config::prior_folder`], [`Config::reference_file`]
/// and [`Config::truth_prior`].
pub const NONE: &str = "none";
/// What [`Config::truth_prior`] says for depth measured over the other test views.
pub const STEREO_PRIOR: &str = "stereo";

impl Default for Config {
    fn default() -> Self {
        Config {
            downscale: 1,
            invert_masks: false,
            dilate_masks: 0,
            test_every: 0,
            leave_out: vec![],
            masks: true,
            relight: true,
            fill_holes: true,
            unit: 0.0,
            even_exposures: true,
            check_priors: true,
            seed_hole: true,
            dense: true,
            rim: 1,
            judge_rim: true,
            whole_reference: false,
            truth_reference: String::new(),
            truth_prior: String::new(),
            prior_folder: String::new(),
            reference_file: String::new(),
        }
    }
}
