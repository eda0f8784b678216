//! Static Gaussians, learnt one by one: on the host and on the device.

use glam::{DMat3, DQuat, DVec3};

use super::parameter::{Names, Parameter, names};
use crate::gpu::{Error, Gpu};
use crate::math::harmonics::{coefficients, turned};
use crate::optimizer::Group;

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
    /// Whether the opacities were trained for antialiasing (Mip-Splatting), where a Gaussian that is smaller than a pixel is
    /// fainter: see [`crate::render::compensate`].
    pub antialiased: bool,
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

    /// Keeps the Gaussians for which `keep` says so, in their order.
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

    /// Counts lengths in units of which `unit` make one of those they are counted in now.
    pub fn rescale(&mut self, unit: f64) {
        if unit != 1.0 {
            let log = unit.ln();
            self.position.iter_mut().for_each(|p| *p = p.map(|x| (f64::from(x) * unit) as f32));
            self.log_scale.iter_mut().for_each(|s| *s = s.map(|x| (f64::from(x) + log) as f32));
        }
    }

    /// The first value that is not finite: the PLY attribute's name without its number, the Gaussian, the value.
    pub fn first_not_finite(&self) -> Option<(&'static str, usize, f32)> {
        let each = coefficients(self.degree);
        let arrays: [(&str, &[f32], usize); 5] = [
            ("xyz", self.position.as_flattened(), 3),
            ("scale", self.log_scale.as_flattened(), 3),
            ("rot", self.rotation.as_flattened(), 4),
            ("opacity", &self.logit, 1),
            ("f_dc or f_rest", self.harmonics.as_flattened(), 3 * each),
        ];
        arrays.into_iter().find_map(|(name, values, width)| {
            let at = values.iter().position(|v| !v.is_finite())?;
            Some((name, at / width, values[at]))
        })
    }

    /// Turns the Gaussians into other axes by a rotation matrix.
    pub fn turn(&mut self, by: DMat3) {
        let each = coefficients(self.degree);
        if each > 1 {
            let matrix = turned(|d| (by * DVec3::from_array(d)).to_array());
            for of in self.harmonics.chunks_exact_mut(each) {
                let before: Vec<[f64; 3]> = of.iter().map(|rgb| rgb.map(f64::from)).collect();
                for (k, rgb) in of.iter_mut().enumerate().skip(1) {
                    *rgb = std::array::from_fn(|c| (0..each).map(|j| matrix[k][j] * before[j][c]).sum::<f64>() as f32);
                }
            }
        }
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

/// Multiplies the coefficients beyond the first of each Gaussian.
fn scale_higher(harmonics: &mut [[f32; 3]], each: usize, by: f64) {
    if by != 1.0 {
        let higher = harmonics.iter_mut().enumerate().filter(|(k, _)| k % each > 0);
        higher.for_each(|(_, rgb)| *rgb = rgb.map(|v| (f64::from(v) * by) as f32));
    }
}

/// Names of what is learnt, in the order of [`Static::parameters`].
pub(crate) const NAMES: [Names; 5] =
    [names!("position"), names!("log_scale"), names!("quaternion"), names!("logit"), names!("harmonics")];

/// Floats per Gaussian of each, for so many coefficients per colour.
pub(crate) const fn widths(coefficients: u32) -> [u32; 5] {
    [3, 3, 4, 1, 3 * coefficients]
}

/// The learnt arrays of static Gaussians, with Adam's moments.
#[derive(Debug)]
pub struct Static {
    /// Gaussians in use.
    pub count: u32,
    /// Gaussians there is room for.
    pub capacity: u32,
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
    /// 3 per coefficient, `(degree + 1)^2` coefficients per Gaussian; those beyond the first divided by `higher`.
    pub harmonics: Parameter,
    /// What a coefficient beyond the first is of what is learnt of it. A step of Adam has a length of its own whatever the
    /// gradient's: it moves these coefficients by so much less.
    pub higher: f32,
    /// As [`Cloud::antialiased`].
    pub antialiased: bool,
}

impl Static {
    /// These Gaussians on the device, moments zero, every coefficient learnt at the same rate.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn upload(gpu: &Gpu, cloud: &Cloud) -> Result<Self, Error> {
        Self::with_room(gpu, cloud, 0, 1.0)
    }

    /// These Gaussians on the device, moments zero, with room for at least `capacity`; coefficients beyond the first are
    /// learnt at `higher` times the rate of the first.
    ///
    /// # Errors
    /// As [`Gpu::buffer`].
    pub fn with_room(gpu: &Gpu, cloud: &Cloud, capacity: u32, higher: f32) -> Result<Self, Error> {
        let count = cloud.len() as u32;
        let each = coefficients(cloud.degree);
        let capacity = capacity.min(Self::most(gpu, cloud.degree)).max(count).max(1);
        let parameter = |group, which: usize, data: &[f32]| {
            let width = widths(each as u32)[which];
            Ok::<_, Error>(Parameter::upload(gpu, NAMES[which], width, capacity, data)?.in_group(group))
        };
        let mut harmonics = cloud.harmonics.clone();
        scale_higher(&mut harmonics, each, 1.0 / f64::from(higher));
        Ok(Self {
            count,
            capacity,
            degree: cloud.degree,
            position: parameter(Group::Position, 0, cloud.position.as_flattened())?,
            log_scale: parameter(Group::LogScale, 1, cloud.log_scale.as_flattened())?,
            quaternion: parameter(Group::Quaternion, 2, cloud.rotation.as_flattened())?,
            logit: parameter(Group::Opacity, 3, &cloud.logit)?,
            harmonics: parameter(Group::Harmonics, 4, harmonics.as_flattened())?,
            higher,
            antialiased: cloud.antialiased,
        })
    }

    /// The most Gaussians of this degree that one binding of the device holds of every array, and a `u32` counts.
    pub fn most(gpu: &Gpu, degree: u32) -> u32 {
        // The widest array, less what rounding to whole vectors may add.
        let widest = 4 * (3 * coefficients(degree) as u64).max(4);
        ((gpu.info().max_binding_bytes.min(u32::MAX.into()) - 48) / widest) as u32
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
    /// Errors of the copies.
    pub fn read(&self, gpu: &Gpu) -> Result<Cloud, Error> {
        let read = |parameter: &Parameter| parameter.read(gpu, self.count);
        let triples = |flat: Vec<f32>| -> Vec<[f32; 3]> { flat.as_chunks().0.to_vec() };
        let unit = |q: &[f32; 4]| {
            let norm = q.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt().max(NORM_EPSILON);
            q.map(|v| (f64::from(v) / norm) as f32)
        };
        let mut harmonics = triples(read(&self.harmonics)?);
        scale_higher(&mut harmonics, coefficients(self.degree), self.higher.into());
        Ok(Cloud {
            position: triples(read(&self.position)?),
            log_scale: triples(read(&self.log_scale)?),
            rotation: read(&self.quaternion)?.as_chunks().0.iter().map(unit).collect(),
            logit: read(&self.logit)?,
            degree: self.degree,
            harmonics,
            antialiased: self.antialiased,
        })
    }
}
