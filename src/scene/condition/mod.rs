//! A capture as read, made ready for training: what of it contradicts the removal is mended here, once, before the model
//! is made.
//!
//! - [`unit`]: lengths are counted in a unit that the scene itself gives, so that the user's unit changes nothing.
//! - [`exposure`]: photographs that are brighter, darker or of another tint than the others are brought to the same exposure.
//! - [`sparse`]: each prior is held against the points of the sparse model. One that does not follow them is not used, and
//!   disparity becomes depth.
//! - [`rim`]: masks fall off around the object, and a note says by how much the inpainted picture was repainted beyond them.
//! - [`judge`]: pixels around the masks that other views do not confirm are the object's too.
//! - [`points`]: points on the object are left out, and the hole gets points from the reference view's prior, behind its
//!   depth edges too; once those of stereo are there the holes of all other views get some where none are.
//! - [`reference`](mod@reference): an inpainted picture counts in its hole alone, and less where other views see past the
//!   object.
//!
//! Each has a setting in [`Config`], and with all of them off the capture stays as it was read.

mod judge;
mod points;
mod reference;
mod rim;
mod sparse;
mod unit;

use super::{Config, Scene, exposure};

pub(crate) use points::{bare, on_object, seed_views};
pub(crate) use sparse::samples;
pub use unit::{footprint, normalize, typical};

/// Makes a scene that was read ready for training, and adds what was done to its notes.
pub fn condition(scene: &mut Scene, config: &Config) {
    unit::normalize(scene, config.unit);
    if config.even_exposures {
        exposure::even_out(scene);
    }
    rim::note_repainted(scene);
    if config.seed_hole {
        points::drop_object(scene);
    }
    if config.check_priors {
        sparse::check_priors(scene);
        reference::guess_priors(scene);
    }
    let depths = reference::hole_depths(scene);
    if config.seed_hole {
        points::seed_holes(scene, &depths);
        points::seed_behind_edges(scene, &depths);
    }
    // What is left of a shadow that was taken out is none of the object, and around it all views have a hole.
    let rims = (config.judge_rim && !scene.relit).then(|| judge::rims(scene));
    rim::soften(scene, config.rim);
    if let Some(rims) = rims {
        rim::raise(scene, &rims);
    }
    if !config.whole_reference {
        reference::composite(scene);
        reference::outrank(scene, &depths);
    }
}
