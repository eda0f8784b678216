//! The forward pass of a model with room that grows: what draws, reads off or questions views of a finished model.

use super::Config;
use super::bin::Binned;
use super::forward::{Capacity, Forward, Representation};
use super::method::Method;
use crate::gpu::{Error, Gpu, Recorder};
use crate::primitives::limit::{Counter, Limits};
use crate::scene::Camera;

/// What the buffers of a session are made for.
#[derive(Clone, Copy, Debug)]
pub struct Room {
    /// How pictures are computed.
    pub method: Method,
    /// Width and height of a picture in pixels.
    pub size: [u32; 2],
    /// Gaussians of the anchors in view.
    pub slots: usize,
    /// (Gaussian, tile) pairs.
    pub pairs: usize,
}

impl Room {
    /// Pixels of a picture.
    pub fn pixels(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }
}

/// The forward stages and the buffers that the caller needs beside them, made together.
pub struct Stages<S> {
    /// What they have room for.
    pub room: Room,
    /// The forward stages.
    pub forward: Forward,
    /// The caller's own.
    pub own: S,
}

/// Runs the forward stages over views of a model. Buffers are made anew for pictures of another size, and for views that need
/// more room.
pub struct Session<S> {
    gpu: Gpu,
    method: Method,
    near: f32,
    cull: bool,
    larger: f64,
    limits: Limits,
    capacity: Capacity,
    make: fn(&Gpu, Room) -> Result<S, Error>,
    stages: Option<Stages<S>>,
}

impl<S> Session<S> {
    /// With this capacity at first. `make` makes the caller's own buffers.
    ///
    /// # Errors
    /// As [`Gpu::buffer`]; [`Error::Missing`] when the device cannot run the configured method.
    pub fn new(
        gpu: &Gpu,
        config: &Config,
        capacity: Capacity,
        make: fn(&Gpu, Room) -> Result<S, Error>,
    ) -> Result<Self, Error> {
        Ok(Self {
            gpu: gpu.clone(),
            method: Method::new(gpu, config),
            near: config.near as f32,
            cull: config.cull,
            larger: 1.0,
            limits: Limits::new(gpu)?,
            capacity,
            make,
            stages: None,
        })
    }

    /// For pictures `larger` times as large as those of the training.
    #[must_use]
    pub fn larger(self, larger: f64) -> Self {
        Self { larger, ..self }
    }

    /// The device.
    pub fn gpu(&self) -> &Gpu {
        &self.gpu
    }

    /// Overflow flag and counters.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// The stages as the last run left them.
    ///
    /// # Panics
    /// Before the first run.
    pub fn stages(&self) -> &Stages<S> {
        self.stages.as_ref().expect("a run made them")
    }

    /// Records and runs the forward stages and `work` for one view; again with more room where something did not fit.
    /// Returns the stages with what the run left in them.
    ///
    /// # Errors
    /// When the device has no room for the view, or is lost.
    ///
    /// # Panics
    /// For more anchors than the capacity's.
    pub fn run(
        &mut self,
        model: &dyn Representation,
        camera: &Camera,
        work: impl Fn(&mut Recorder<'_>, &Stages<S>, Binned<'_>),
    ) -> Result<&Stages<S>, Error> {
        Ok(self.run_within(model, camera, u32::MAX, work)?.expect("no view has more pairs than can be counted"))
    }

    /// As [`Session::run`]; `None` for a view of more than `most` (Gaussian, tile) pairs, if there is no room for them yet.
    ///
    /// # Errors
    /// As [`Session::run`].
    ///
    /// # Panics
    /// As [`Session::run`].
    pub fn run_within(
        &mut self,
        model: &dyn Representation,
        camera: &Camera,
        most: u32,
        work: impl Fn(&mut Recorder<'_>, &Stages<S>, Binned<'_>),
    ) -> Result<Option<&Stages<S>>, Error> {
        let (gpu, limits) = (self.gpu.clone(), self.limits.share());
        let fits = limits.until_all_fits(&gpu, |counted| -> Result<bool, Error> {
            if let Some(counted) = counted {
                if counted[Counter::Pairs as usize] > most {
                    return Ok(false);
                }
                self.capacity = self.capacity.fit(counted).within(&gpu, counted);
                self.stages = None;
            }
            // Those of another size go before these are made.
            let kept = self.stages.take().filter(|stages| stages.room.size == camera.size);
            let stages = match kept {
                Some(stages) => stages,
                None => self.allocate(model, camera.size)?,
            };
            let mut rec = gpu.recorder()?;
            let binned = stages.forward.record(&mut rec, model, camera, self.near, &limits);
            work(&mut rec, &stages, binned);
            rec.submit()?.wait()?;
            self.stages = Some(stages);
            Ok(true)
        })?;
        Ok(if fits { self.stages.as_ref() } else { None })
    }

    fn allocate(&self, model: &dyn Representation, size: [u32; 2]) -> Result<Stages<S>, Error> {
        let Self { gpu, method, capacity, .. } = self;
        let mut forward = Forward::new(gpu, *capacity, model, *method, size, self.cull)?;
        let room = Room { method: *method, size, slots: forward.slots as usize, pairs: capacity.pairs as usize };
        forward.larger = self.larger;
        Ok(Stages { room, forward, own: (self.make)(gpu, room)? })
    }
}
