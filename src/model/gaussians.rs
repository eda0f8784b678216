//! Static Gaussians, learnt one by one: on the host and on the device.

use glam::{DMat3, DQuat, DVec3};

use super::parameter::{Parameter, names};
use crate::gpu::{Error, Gpu};
use crate::math::harmonics::coefficients;

/// Shortest quaternion that is normalised to length one.
pub(crate) const NORM_EPSILON: f64 = 1e-12;

/// Static Gaussians: what a viewer draws.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Cloud {
    /// \[gaussian\] scene units.
    pub position: Vec<[f32; 3]>,
    /// \[gaussian\] natural logarithms of the standard deviations in scene units.
    pub log_scale: Vec<[f32; 3]>,
    /// \[gaussian\] unit quaternions w x y z.
    pub rotation: Vec<[f32; 4]>,
    /// \[gaussian\] logit of the opacity.
    pub logit: Vec<f32>,
    /// Highest degree of the harmonics, 0 to 3.
    pub degree: u32,
    /// \[gaussian, coefficient\] rgb, `(degree + 1)^2` coefficients: see [`crate::math::harmonics`].
    pub harmonics: Vec<[f32; 3]>,
}

impl Cloud {
    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.position.len()
    }

    /// True without Gaussians.
    pub fn is_empty(&self) -> bool {
        self.position.is_empty()
    }

    /// The coefficients of one Gaussian.
    pub fn harmonics_of(&self, i: usize) -> &[[f32; 3]] {
        let each = coefficients(self.degree);
        &self.harmonics[i * each..(i + 1) * each]
    }

    /// Those for which `keep` says so, in their order.
    pub fn retain(&mut self, keep: &[bool]) {
        fn kept<T: Copy>(from: &mut Vec<T>, keep: &[bool], each: usize) {
            let mut flags = keep.iter().flat_map(|k| std::iter::repeat_n(*k, each));
            from.retain(|_| flags.next().unwrap_or(true));
        }
        let each = coefficients(self.degree);
        kept(&mut self.position, keep, 1);
        kept(&mut self.log_scale, keep, 1);
        kept(&mut self.rotation, keep, 1);
        kept(&mut self.logit, keep, 1);
        kept(&mut self.harmonics, keep, each);
    }

    /// The same Gaussians in axes turned by a rotation matrix.
    ///
    /// # Panics
    /// With harmonics beyond degree 0, which are to be fitted in the axes they are written in.
    pub fn turn(&mut self, by: DMat3) {
        assert_eq!(self.degree, 0, "harmonics are not turned");
        let turn = DQuat::from_mat3(&by);
        for position in &mut self.position {
            *position = (by * DVec3::from_array(position.map(f64::from))).to_array().map(|v| v as f32);
        }
        for rotation in &mut self.rotation {
            let [w, x, y, z] = rotation.map(f64::from);
            let q = (turn * DQuat::from_xyzw(x, y, z, w)).normalize();
            *rotation = [q.w, q.x, q.y, q.z].map(|v| v as f32);
        }
    }
}

/// The opacity of a logit, 0 to 1.
pub fn sigmoid(logit: f32) -> f64 {
    1.0 / (1.0 + (-f64::from(logit)).exp())
}

/// The logit of an opacity, finite: opacities are cut off at the largest alpha of a sample and at what a viewer skips.
pub fn logit(opacity: f64) -> f32 {
    let o = opacity.clamp(1e-4, 0.9999);
    (o / (1.0 - o)).ln() as f32
}

/// What is learnt of static Gaussians, with Adam's moments.
#[derive(Debug)]
pub struct Static {
    /// Gaussians.
    pub count: u32,
    /// Highest degree of the harmonics.
    pub degree: u32,
    /// 3 per Gaussian, world.
    pub position: Parameter,
    /// 3 per Gaussian, natural logarithms of scene units.
    pub log_scale: Parameter,
    /// 4 per Gaussian, w x y z.
    pub quaternion: Parameter,
    /// 1 per Gaussian, logit of the opacity.
    pub logit: Parameter,
    /// 3 per coefficient, `(degree + 1)^2` coefficients per Gaussian.
    pub harmonics: Parameter,
}

impl Static {
    /// These Gaussians on the device, moments zero.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn upload(gpu: &Gpu, cloud: &Cloud) -> Result<Self, Error> {
        let count = cloud.len() as u32;
        let each = coefficients(cloud.degree) as u32;
        let rows = count.max(1);
        let parameter = |names, width, data: &[f32]| Parameter::upload(gpu, names, width, rows, data);
        Ok(Self {
            count,
            degree: cloud.degree,
            position: parameter(names!("position"), 3, cloud.position.as_flattened())?,
            log_scale: parameter(names!("log_scale"), 3, cloud.log_scale.as_flattened())?,
            quaternion: parameter(names!("quaternion"), 4, cloud.rotation.as_flattened())?,
            logit: parameter(names!("logit"), 1, &cloud.logit)?,
            harmonics: parameter(names!("harmonics"), 3 * each, cloud.harmonics.as_flattened())?,
        })
    }

    /// Position, log-scale, quaternion, logit, harmonics.
    pub fn parameters(&self) -> [&Parameter; 5] {
        [&self.position, &self.log_scale, &self.quaternion, &self.logit, &self.harmonics]
    }

    /// The same, to be changed.
    pub fn parameters_mut(&mut self) -> [&mut Parameter; 5] {
        [&mut self.position, &mut self.log_scale, &mut self.quaternion, &mut self.logit, &mut self.harmonics]
    }

    /// The Gaussians as they are now, quaternions normalised.
    ///
    /// # Errors
    /// Whatever the copies meet.
    pub fn read(&self, gpu: &Gpu) -> Result<Cloud, Error> {
        let read = |parameter: &Parameter| parameter.read(gpu, self.count);
        let triples = |flat: Vec<f32>| -> Vec<[f32; 3]> { flat.as_chunks().0.to_vec() };
        let unit = |q: &[f32; 4]| {
            let norm = q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt().max(NORM_EPSILON);
            q.map(|v| (f64::from(v) / norm) as f32)
        };
        Ok(Cloud {
            position: triples(read(&self.position)?),
            log_scale: triples(read(&self.log_scale)?),
            rotation: read(&self.quaternion)?.as_chunks().0.iter().map(unit).collect(),
            logit: read(&self.logit)?,
            degree: self.degree,
            harmonics: triples(read(&self.harmonics)?),
        })
    }
}
