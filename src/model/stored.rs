//! A whole model on the host and on disk, in one of its forms.

use std::io::Write as _;
use std::path::Path;

use super::config::Form;
use super::files::{self, Anchors, Error, POINT_CLOUD, Weights};
use super::gaussians::Cloud;
use crate::formats::ply;

/// A model.
#[derive(Debug, Clone, PartialEq)]
pub enum Stored {
    /// Anchors and their networks: `point_cloud.ply` and `weights.safetensors`, see [`files`].
    Anchors(Anchors, Weights),
    /// Plain Gaussians: `point_cloud.ply` in the layout of 3D Gaussian Splatting, see [`ply`].
    Gaussians(Cloud),
}

impl Stored {
    /// The form that it is of.
    pub fn form(&self) -> Form {
        match self {
            Self::Anchors(..) => Form::Anchors,
            Self::Gaussians(_) => Form::Gaussians,
        }
    }

    /// The positions of the anchors or of the plain Gaussians, scene units.
    pub fn positions(&self) -> &[[f32; 3]] {
        match self {
            Self::Anchors(anchors, _) => &anchors.position,
            Self::Gaussians(cloud) => &cloud.position,
        }
    }

    /// The networks, of a model that has them.
    pub fn weights(&self) -> Option<&Weights> {
        if let Self::Anchors(_, weights) = self { Some(weights) } else { None }
    }

    /// Counts the model's lengths in units of which `unit` make one of those they are counted in now, and leaves what it
    /// shows as it is.
    pub fn rescale(&mut self, unit: f64) {
        match self {
            Self::Anchors(anchors, weights) => files::rescale(anchors, weights, unit),
            Self::Gaussians(cloud) => cloud.rescale(unit),
        }
    }

    /// Writes the model into `folder`, creating it; its files appear complete or not at all.
    ///
    /// # Errors
    /// A folder that cannot be written, or a model whose parts do not fit each other.
    pub fn save(&self, folder: &Path) -> Result<(), Error> {
        let cloud = match self {
            Self::Anchors(anchors, weights) => return files::save(folder, anchors, weights),
            Self::Gaussians(cloud) => cloud,
        };
        std::fs::create_dir_all(folder).map_err(|source| Error::Io { path: folder.to_owned(), source })?;
        let path = folder.join(POINT_CLOUD);
        let file = files::write_temporary(&path, |out| out.write_all(&ply::encode(cloud)))?;
        file.commit().map_err(|source| Error::Io { path, source })
    }

    /// Reads what [`Stored::save`] wrote; the point cloud's own attributes say which form it is.
    ///
    /// # Errors
    /// A file that is missing, foreign or cut off, or holds a value that is not finite.
    pub fn load(folder: &Path) -> Result<Self, Error> {
        let path = folder.join(POINT_CLOUD);
        let bytes = std::fs::read(&path).map_err(|source| Error::Io { path: path.clone(), source })?;
        if !ply::is_gaussians(&bytes) {
            drop(bytes);
            let (anchors, weights) = files::load(folder)?;
            return Ok(Self::Anchors(anchors, weights));
        }
        let refused = |reason| Error::Format { path: path.clone(), reason };
        let cloud = ply::decode(&bytes).map_err(refused)?;
        if cloud.is_empty() {
            return Err(refused("it holds no Gaussian; train the scene again".to_owned()));
        }
        match cloud.first_not_finite() {
            Some((attribute, vertex, value)) => {
                Err(Error::NotFinite { path: path.clone(), attribute: attribute.to_owned(), vertex, value })
            }
            None => Ok(Self::Gaussians(cloud)),
        }
    }
}
