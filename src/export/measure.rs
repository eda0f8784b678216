//! What the export costs: pictures of the static Gaussians against the anchors' own and against the photographs.

use std::fmt::Write as _;

use image::{GrayImage, RgbImage};
use serde::Serialize;

use super::draw::Drawer;
use super::{Cloud, Error, low_pass};
use crate::evaluate::{self, Mean, Report, ViewMetrics};
use crate::gpu::{self, Gpu};
use crate::model::gaussians::Static;
use crate::render::Config;
use crate::render::forward::Capacity;
use crate::render::view::{Painter, Renderer, to_rgb8};
use crate::scene::{Camera, Scene};

/// A pose to measure at.
struct Pose {
    name: String,
    camera: Camera,
    /// The anchors' picture.
    anchors: RgbImage,
    photograph: Option<RgbImage>,
    mask: Option<GrayImage>,
}

/// Poses that neither baking nor refinement looks from, with the pictures to compare with.
pub struct Yardstick {
    poses: Vec<Pose>,
    /// What the poses are, for who reads the figures.
    pub what: String,
}

/// Means over the poses.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Loss {
    /// Against the anchors' pictures.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub anchors: Option<Mean>,
    /// Against the photographs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub photographs: Option<Mean>,
}

impl Yardstick {
    /// The test views, or without any these cameras, in the cloud's axes: `turned` brings a camera into them.
    ///
    /// # Errors
    /// When the device has no room, or is lost.
    pub fn new(
        renderer: &mut Renderer,
        scene: &Scene,
        without_tests: &[Camera],
        turned: impl Fn(&Camera) -> Camera,
        mut progress: impl FnMut(),
    ) -> Result<Self, Error> {
        let mut draw = |camera: &Camera| -> Result<RgbImage, Error> {
            progress();
            Ok(renderer.render(camera)?.to_rgb8())
        };
        if scene.test.is_empty() {
            let poses = without_tests.iter().enumerate().map(|(i, camera)| {
                let (name, anchors) = (format!("pose {i}"), draw(camera)?);
                Ok(Pose { name, camera: turned(camera), anchors, photograph: None, mask: None })
            });
            let what = format!("{} poses between training cameras, seen by no step", without_tests.len());
            return Ok(Self { poses: poses.collect::<Result<_, Error>>()?, what });
        }
        let poses = scene.test.iter().map(|view| {
            Ok(Pose {
                name: view.name.clone(),
                camera: turned(&view.camera),
                anchors: draw(&view.camera)?,
                photograph: Some(view.image.clone()),
                mask: view.mask.clone(),
            })
        });
        Ok(Self { poses: poses.collect::<Result<_, Error>>()?, what: format!("{} test views", scene.test.len()) })
    }

    /// Number of poses.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// True without poses.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// The anchors themselves against the photographs.
    ///
    /// # Errors
    /// Pictures that cannot be compared.
    pub fn of_anchors(&self) -> Result<Loss, Error> {
        Ok(Loss { anchors: None, photographs: self.mean(|pose| Some((&pose.anchors, pose.photograph.as_ref()?)))? })
    }

    /// These Gaussians, on `times` as many pixels each way as the pictures have, reduced to those, or on fewer where the device
    /// has no room for so many; and how many times as many it were.
    ///
    /// # Errors
    /// When the device has no room for the pictures as they are, or is lost.
    pub fn of_cloud(&self, gpu: &Gpu, cloud: &Cloud, times: u32, config: &Config) -> Result<(Loss, u32), Error> {
        let gaussians = Static::upload(gpu, cloud)?;
        let mut fits = times.max(1);
        loop {
            let mut painter = Painter::new(gpu, config, Capacity::guess(gaussians.count))?;
            let loss = self.of_drawing(|camera| Ok(painter.render(&gaussians, camera)?.rgb), fits);
            match loss {
                Err(Error::Gpu(gpu::Error::TooLarge { .. } | gpu::Error::OutOfMemory { .. })) if fits > 1 => fits -= 1,
                loss => return Ok((loss?, fits)),
            }
        }
    }

    /// The Gaussians of a drawer as they are now.
    ///
    /// # Errors
    /// As [`Yardstick::of_cloud`].
    pub fn of_drawer(&self, drawer: &mut Drawer) -> Result<Loss, Error> {
        self.of_drawing(|camera| Ok(drawer.draw(camera)?), 1)
    }

    fn of_drawing(
        &self,
        mut draw: impl FnMut(&Camera) -> Result<Vec<[f32; 3]>, Error>,
        times: u32,
    ) -> Result<Loss, Error> {
        let draw = |pose: &Pose| {
            let large = pose.camera.scaled(pose.camera.size.map(|n| n * times));
            Ok(to_rgb8(pose.camera.size, &low_pass::reduced(&draw(&large)?, large.size, times)))
        };
        let pictures: Vec<RgbImage> = self.poses.iter().map(draw).collect::<Result<_, Error>>()?;
        let mut pictures_again = pictures.iter();
        let anchors = self.mean(|pose| Some((pictures_again.next()?, &pose.anchors)))?;
        let mut pictures = pictures.iter();
        Ok(Loss { anchors, photographs: self.mean(|pose| Some((pictures.next()?, pose.photograph.as_ref()?)))? })
    }

    fn mean<'a>(
        &'a self,
        mut pair: impl FnMut(&'a Pose) -> Option<(&'a RgbImage, &'a RgbImage)>,
    ) -> Result<Option<Mean>, Error> {
        let views = self.poses.iter().filter_map(|pose| {
            let (picture, truth) = pair(pose)?;
            let metrics = evaluate::compare(picture, truth, pose.mask.as_ref());
            Some(metrics.map(|metrics| ViewMetrics { name: pose.name.clone(), metrics }))
        });
        Ok(Report::new(views.collect::<Result<_, _>>()?).mean)
    }
}

/// An aligned table of what was measured, a line per name.
pub fn table(lines: &[(String, Loss)]) -> String {
    let first = lines.first().map_or("anchors", |(name, _)| name);
    let width = lines.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    let masked = |mean: &Option<Mean>| mean.is_some_and(|mean| mean.metrics.mask.is_some());
    let photographs = lines.iter().any(|(_, loss)| loss.photographs.is_some());
    let masks = lines.iter().any(|(_, loss)| masked(&loss.photographs) || masked(&loss.anchors));
    let group = if masks { 32 } else { 15 };
    let mut text = format!("{:width$}  {:>group$}", "", format!("against the {first}"));
    if photographs {
        write!(text, "  {:>group$}", "against photographs").expect("a string takes everything");
    }
    let heads = if masks { "   PSNR    SSIM  mask's   mask's" } else { "   PSNR    SSIM" };
    write!(text, "\n{:width$}  {heads:>group$}", "").expect("a string takes everything");
    if photographs {
        write!(text, "  {heads:>group$}").expect("a string takes everything");
    }
    let column = |text: &mut String, mean: &Option<Mean>| {
        let figures = |f: Option<evaluate::Figures>| {
            f.map_or_else(|| format!("{:>7} {:>7}", "-", "-"), |f| format!("{:>7.2} {:>7.4}", f.psnr, f.ssim))
        };
        let mut cell = figures(mean.map(|mean| mean.metrics.full));
        if masks {
            cell = format!("{cell} {}", figures(mean.and_then(|mean| mean.metrics.mask)));
        }
        write!(text, "  {cell:>group$}").expect("a string takes everything");
    };
    for (name, loss) in lines {
        write!(text, "\n{name:width$}").expect("a string takes everything");
        column(&mut text, &loss.anchors);
        if photographs {
            column(&mut text, &loss.photographs);
        }
    }
    text.push('\n');
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::export::tests::cloud;
    use crate::gpu::testing;

    /// Square pictures of a training that ends at their full size, four times as large: what a training needs for a picture is more
    /// than one binding of lavapipe holds. Where the picture alone is too large it is drawn less large.
    #[test]
    fn large_pictures_are_measured_as_large_as_the_device_can() {
        let gpu = testing::gpu();
        let mut cloud = cloud(100, 0);
        cloud.log_scale.fill([-1.0; 3]);
        for (side, least) in [(512, 4), (1100, 1)] {
            let camera = Camera {
                rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
                translation: [0.0, 0.0, 10.0],
                focal: [side as f32; 2],
                principal: [side as f32 / 2.0; 2],
                distortion: [0.0; 4],
                size: [side; 2],
            };
            let config = Config::default();
            let mut painter = Painter::new(&gpu, &config, Capacity::guess(100)).expect("room");
            let gaussians = Static::upload(&gpu, &cloud).expect("room");
            let anchors = painter.render(&gaussians, &camera).expect("a picture").to_rgb8();
            let pose = Pose { name: "pose".into(), camera, anchors, photograph: None, mask: None };
            let yardstick = Yardstick { poses: vec![pose], what: String::new() };
            let (loss, times) = yardstick.of_cloud(&gpu, &cloud, 4, &config).expect("a measurement");
            let [most, limit] = [u64::from(times + 1) * u64::from(side), gpu.info().max_binding_bytes];
            assert!(times >= least && (times == 4 || 12 * most * most > limit), "{side}: {times} times");
            // Gaussians of many pixels look the same when a larger picture is reduced.
            let psnr = loss.anchors.expect("a picture to compare with").metrics.full.psnr;
            assert!(psnr > 45.0, "{side}: {psnr} dB");
        }
    }
}
