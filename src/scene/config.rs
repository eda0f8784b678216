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
    /// Use the depth priors.
    pub priors: bool,
    /// Take the object's shadow out of the photographs, where `prepare` has found it (`relight/`).
    pub relight: bool,
    /// Train the other views on their holes as `prepare` has filled them (`hole/`), instead of on nothing there (GScream: off).
    pub fill_holes: bool,
    /// Use the inpainted reference view.
    pub reference: bool,
    /// Length of the model's that counts as one wherever a setting means a length; 0 takes a third of the median depth of
    /// the points, so that the unit of the capture changes nothing (GScream: 1).
    pub unit: f64,
    /// Divide each photograph by its exposure and white balance over the others', by what they show of the same points, where
    /// these differ (GScream: off).
    pub even_exposures: bool,
    /// Leave out points that fall into the mask in more than this share of the views that have them in the picture: they
    /// stand on the object. 1 keeps all (GScream).
    pub object_point_share: f64,
    /// Hold each prior against the points of the model: one that does not follow them is not used, and disparity is
    /// turned into depth.
    pub check_priors: bool,
    /// Guess the depth of a reference picture without prior from the points around its hole.
    pub guess_reference_prior: bool,
    /// Add points in the hole, at the depth of the reference's prior, and behind its depth edges, where other train
    /// cameras see what neither the reference nor any photograph shows.
    pub seed_hole: bool,
    /// Add points where the photographs agree on a depth and the model has none, and on planes around what stays unknown:
    /// floors, walls and what is far off get anchors, too. A view in which hardly anything agrees with the others is left
    /// out (GScream: off).
    pub dense: bool,
    /// Let the train masks grow by as many pixels as an inpainted picture was repainted beyond its own: the object's shadow
    /// goes with it, and what the photographs show there. A picture that is the photograph outside its mask changes nothing.
    pub grow_masks: bool,
    /// Let the train masks fall off over so many pixels around the object, at the training size: its antialiased edge and
    /// shadow reach beyond the mask. 0: masks are hard (GScream).
    pub rim: u32,
    /// Hold the pixels around the train masks against the other views: what disagrees with them and hangs together with the
    /// mask counts less, or not at all. Masks that are too tight, reflections (GScream: off).
    pub judge_rim: bool,
    /// Use the inpainted picture outside its hole too (GScream), instead of the photograph.
    pub whole_reference: bool,
    /// So many other views that see a part of the hole past the object outrank the painted picture there, fewer in
    /// proportion; 0: the painted picture counts everywhere alike (GScream).
    pub outrank_guess: u32,
    /// Name of a test view, which shows the place without the object, to train on as the reference in place of the
    /// delivered one: what was inpainted is then the truth. Its hole is its test mask. Empty for the delivered reference.
    pub truth_reference: String,
    /// Depth prior of that view: a file, in the scene's folder unless the path is absolute. Empty for the one under the
    /// view's name among the scene's priors, or its true depth, if there is one; `none` for no prior; `stereo` for depth
    /// measured over the other test views, by [`condition`](super::condition).
    pub truth_prior: String,
    /// Depth priors in place of the scene's own: a folder, in the scene's unless the path is absolute. Its name says
    /// `disparity`, or it is depth; `reference/` in it has the inpainted picture's. Empty for the scene's own.
    pub prior_folder: String,
    /// Inpainted picture in place of the delivered one: a file, in the scene's folder unless the path is absolute. It is
    /// that of the train view whose name it has, or of the delivered picture's view. Empty for the delivered one.
    pub reference_file: String,
}

impl Config {
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
        let share = self.object_point_share;
        ensure(
            (0.0..=1.0).contains(&share),
            "object_point_share",
            share,
            "must be between 0 and 1 (1 keeps all points)",
        )?;
        ensure(self.rim <= 64, "rim", self.rim, "must be at most 64 pixels")
    }
}

/// Largest [`Config::dilate_masks`]: a mask that needs more is none of the object.
const MOST_DILATION: u32 = 1024;

/// What [`Config::truth_prior`] says for no prior.
pub(super) const NO_PRIOR: &str = "none";
/// What [`Config::truth_prior`] says for depth measured over the other test views.
pub(super) const STEREO_PRIOR: &str = "stereo";

impl Default for Config {
    fn default() -> Self {
        Config {
            downscale: 1,
            invert_masks: false,
            dilate_masks: 0,
            test_every: 0,
            leave_out: vec![],
            masks: true,
            priors: true,
            relight: true,
            fill_holes: true,
            reference: true,
            unit: 0.0,
            even_exposures: true,
            object_point_share: 0.9,
            check_priors: true,
            guess_reference_prior: true,
            seed_hole: true,
            dense: true,
            grow_masks: false,
            rim: 1,
            judge_rim: true,
            whole_reference: false,
            outrank_guess: 5,
            truth_reference: String::new(),
            truth_prior: String::new(),
            prior_folder: String::new(),
            reference_file: String::new(),
        }
    }
}
