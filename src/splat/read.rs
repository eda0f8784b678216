//! Splats of other programs: what a file holds, and how the file is written again with only some Gaussians changed.

use std::path::Path;

use super::Error;
use super::ply::{self, Rows};
use crate::formats::{gltf, sog, splat as dotsplat, spz};
use crate::math::harmonics::coefficients;
use crate::model::gaussians::Cloud;
use crate::sentence::one_line;

/// What a splat is kept in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Container {
    /// PLY with a row of numbers per Gaussian.
    Ply,
    /// PLY as SuperSplat compresses it.
    CompressedPly,
    /// SPZ.
    Spz,
    /// SOG, bundled.
    Sog,
    /// antimatter15's rows of 32 bytes.
    Splat,
    /// glTF with `KHR_gaussian_splatting`.
    Glb,
}

/// Extensions of files of splats.
const EXTENSIONS: [&str; 5] = ["ply", "spz", "sog", "splat", "glb"];

fn extension(path: &Path) -> String {
    path.extension().map_or_else(String::new, |extension| extension.to_string_lossy().to_lowercase())
}

/// A splat.
#[derive(Clone, Debug)]
pub struct Splat {
    /// What it was read from.
    pub container: Container,
    /// Its Gaussians in the file's order, as they can be drawn: see [`Splat::drawn`].
    pub cloud: Cloud,
    /// Whether a Gaussian has numbers throughout and a size. Others are kept in the file and drawn nowhere.
    pub drawn: Vec<bool>,
    rows: Option<Rows>,
}

/// Largest logit that is drawn; files have infinity for an opacity of 1.
const MOST_LOGIT: f32 = 20.0;
/// Natural logarithms of standard deviations that are drawn, scene units; files have minus infinity for flat Gaussians.
const LOG_SCALES: [f32; 2] = [-30.0, 20.0];

/// Whether the file has a splat's name.
pub fn is_splat(path: &Path) -> bool {
    path.is_file() && EXTENSIONS.contains(&extension(path).as_str())
}

/// Reads a splat.
///
/// # Errors
/// A file that cannot be read, is not of a splat, is cut off, or holds no Gaussian that can be drawn.
pub fn read(path: &Path) -> Result<Splat, Error> {
    let bytes = std::fs::read(path).map_err(|source| Error::Io { path: path.to_owned(), source })?;
    // Rows of 32 bytes have no first words to know them by.
    let splat = if extension(path) == "splat" { rows(&bytes) } else { decode(bytes) };
    splat.map_err(|what| Error::File { path: path.to_owned(), what })
}

/// The same from a file's bytes.
///
/// # Errors
/// What is wrong, in words that follow the file's name.
pub fn decode(bytes: Vec<u8>) -> Result<Splat, String> {
    // Words of the file may be of any length and of any characters.
    decoded(bytes).map_err(|what| one_line(&what))
}

fn decoded(bytes: Vec<u8>) -> Result<Splat, String> {
    let (container, cloud, rows) = match bytes.get(..4) {
        Some(b"ply\n" | b"ply\r") => {
            let (cloud, rows) = ply::read(bytes)?;
            (if rows.is_some() { Container::Ply } else { Container::CompressedPly }, cloud, rows)
        }
        Some(b"glTF") => (Container::Glb, gltf::decode(&bytes)?, None),
        Some([0x1f, 0x8b, ..] | b"NGSP") => (Container::Spz, spz::decode(&bytes)?, None),
        Some(b"PK\x03\x04") => (Container::Sog, sog::decode(&bytes)?, None),
        _ => return Err("it is none of PLY, SPZ, SOG and GLB; splats come in these, and in files called .splat".into()),
    };
    whole(container, cloud, rows)
}

fn rows(bytes: &[u8]) -> Result<Splat, String> {
    whole(Container::Splat, dotsplat::decode(bytes)?, None)
}

fn whole(container: Container, cloud: Cloud, rows: Option<Rows>) -> Result<Splat, String> {
    if cloud.is_empty() {
        return Err("it holds no Gaussian".into());
    }
    let mut splat = Splat { container, drawn: vec![true; cloud.len()], cloud, rows };
    splat.settle();
    if !splat.drawn.contains(&true) {
        return Err(format!("none of its {} Gaussians has finite numbers", splat.cloud.len()));
    }
    Ok(splat)
}

impl Splat {
    /// Brings what files have at infinity within what is drawn, and takes out what is no number.
    fn settle(&mut self) {
        let each = coefficients(self.cloud.degree);
        let Cloud { position, log_scale, rotation, logit, harmonics, .. } = &mut self.cloud;
        for (i, drawn) in self.drawn.iter_mut().enumerate() {
            logit[i] = logit[i].clamp(-MOST_LOGIT, MOST_LOGIT);
            log_scale[i] = log_scale[i].map(|v| v.clamp(LOG_SCALES[0], LOG_SCALES[1]));
            let finite = |values: &[f32]| values.iter().all(|v| v.is_finite());
            let own = i * each..(i + 1) * each;
            *drawn = finite(&position[i])
                && finite(&log_scale[i])
                && finite(&rotation[i])
                && rotation[i].iter().any(|v| v.abs() > 1e-12)
                && logit[i].is_finite()
                && finite(harmonics[own.clone()].as_flattened());
            if !*drawn {
                (position[i], log_scale[i], rotation[i]) = ([0.0; 3], [LOG_SCALES[0]; 3], [1.0, 0.0, 0.0, 0.0]);
                logit[i] = -MOST_LOGIT;
                harmonics[own].fill([0.0; 3]);
            }
        }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.cloud.len()
    }

    /// Whether there are none, which no splat that was read is.
    pub fn is_empty(&self) -> bool {
        self.cloud.is_empty()
    }

    /// A PLY file with the Gaussians of `kept` in their order, and those of `added` behind them. Those of a PLY with a row
    /// per Gaussian keep every byte; of other containers their numbers as they were read.
    ///
    /// # Panics
    /// Unless there is a flag for every Gaussian.
    pub fn spliced(&self, kept: &[bool], added: &Cloud) -> Vec<u8> {
        if let Some(rows) = &self.rows {
            return rows.spliced(kept, added);
        }
        crate::formats::ply::encode(&self.joined(kept, added))
    }

    /// The Gaussians of `kept` in their order, as they are drawn, and those of `added` behind them.
    ///
    /// # Panics
    /// Unless there is a flag for every Gaussian.
    pub fn joined(&self, kept: &[bool], added: &Cloud) -> Cloud {
        assert_eq!(kept.len(), self.len(), "a flag for every Gaussian");
        let mut cloud = self.cloud.clone();
        cloud.retain(kept);
        append(&mut cloud, added);
        cloud
    }
}

/// Puts Gaussians behind others, with as many coefficients as those have.
pub fn append(cloud: &mut Cloud, added: &Cloud) {
    let added = of_degree(added, cloud.degree);
    cloud.position.extend_from_slice(&added.position);
    cloud.log_scale.extend_from_slice(&added.log_scale);
    cloud.rotation.extend_from_slice(&added.rotation);
    cloud.logit.extend_from_slice(&added.logit);
    cloud.harmonics.extend_from_slice(&added.harmonics);
}

/// The same Gaussians with harmonics up to this degree: zero where they had none, those beyond left out.
pub fn of_degree(cloud: &Cloud, degree: u32) -> Cloud {
    let each = coefficients(degree);
    let of = |i: usize| {
        let own = cloud.harmonics_of(i);
        (0..each).map(move |k| own.get(k).copied().unwrap_or_default())
    };
    Cloud { degree, harmonics: (0..cloud.len()).flat_map(of).collect(), ..cloud.clone() }
}
