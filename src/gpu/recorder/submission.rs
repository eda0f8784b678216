//! Work given to the device, and the wait for it.

use std::collections::BTreeMap;
use std::sync::Arc;

use ash::vk;

use crate::gpu::check::Difference;
use crate::gpu::commands::{Command, Commands};
use crate::gpu::context::{Context, MAX_PASSES};
use crate::gpu::device::{Gpu, lock};
use crate::gpu::error::{Error, Named};
use crate::gpu::hazards::Schedule;
use crate::gpu::ledger::Rehearsal;
use crate::gpu::timings::Timing;

/// Where recorded passes go.
pub(super) enum Target {
    /// To the device.
    Device(Context),
    /// Nowhere: a rehearsal keeps the books.
    Books(Arc<Rehearsal>),
}

impl Target {
    /// What the device runs, but in a rehearsal.
    pub(super) fn context(&self) -> Option<&Context> {
        match self {
            Self::Device(context) => Some(context),
            Self::Books(_) => None,
        }
    }
}

/// Work given to the device.
#[must_use = "wait() frees what the submission holds"]
pub struct Submission<'g> {
    pub(super) gpu: &'g Gpu,
    /// The place that the passes went to, until they were waited for.
    pub(super) target: Option<Target>,
    /// The queue has taken it.
    pub(super) submitted: bool,
    pub(super) passes: Vec<&'static str>,
    /// What was recorded.
    pub schedule: Schedule,
    /// What the device was given for it, in this order. A submission begins with a barrier and ends with one to the host.
    pub commands: Vec<Command>,
    /// GPU against twin, of a checked recording.
    pub differences: Vec<Difference>,
    /// The wanted buffers of a traced recording by name, as the last pass that wrote them left them.
    pub trace: BTreeMap<&'static str, Vec<u32>>,
}

impl Submission<'_> {
    fn context(&self) -> Option<&Context> {
        self.target.as_ref().and_then(Target::context)
    }

    pub(super) fn start(&mut self) -> Result<(), Error> {
        let inner = self.gpu.inner();
        let Some(context) = self.target.as_ref().and_then(Target::context) else { return Ok(()) };
        Commands { inner, raw: context.commands, noted: &mut self.commands }.barrier_to_host();
        let commands = [vk::CommandBufferSubmitInfo::default().command_buffer(context.commands)];
        let submit = [vk::SubmitInfo2::default().command_buffer_infos(&commands)];
        // SAFETY: the command buffer is in recording, its fence is new or was reset when it was last waited for, and the guard of
        // the queue is held.
        let result = unsafe {
            inner.device.end_command_buffer(context.commands).named("ending a command buffer")?;
            inner.device.queue_submit2(*lock(&inner.queue), &submit, context.fence)
        };
        self.submitted = result.is_ok();
        self.lost(result, "submitting work")
    }

    fn lost(&self, result: ash::prelude::VkResult<()>, what: &'static str) -> Result<(), Error> {
        match result {
            Ok(()) => Ok(()),
            Err(vk::Result::ERROR_DEVICE_LOST) => {
                let markers = self.context().and_then(|context| context.markers.as_ref());
                let markers = markers.and_then(|(_, allocation)| allocation.mapped_slice());
                Err(Error::DeviceLost { place: place_of_fault(&self.passes, markers) })
            }
            Err(result) => Err(Error::Vulkan { what, result }),
        }
    }

    /// Waits for the end and returns the time of every pass (empty unless the device was opened with timestamps).
    ///
    /// # Errors
    /// [`Error::DeviceLost`] with the pass, where faults are traced.
    pub fn wait(mut self) -> Result<Vec<Timing>, Error> {
        let inner = self.gpu.inner().clone();
        let Some(context) = self.context() else { return Ok(vec![]) };
        // SAFETY: the fence was given to the queue in `start`.
        let result = unsafe { inner.device.wait_for_fences(&[context.fence], true, u64::MAX) };
        self.lost(result, "waiting for work")?;
        let mut timings = vec![];
        if inner.options.timestamps && inner.info.timestamp_period > 0.0 {
            let timed = self.passes.len().min(MAX_PASSES as usize);
            let mut ticks = vec![0u64; 2 * timed];
            if timed > 0 {
                // SAFETY: the queries were reset and written by the finished command buffer.
                unsafe {
                    let flags = vk::QueryResultFlags::TYPE_64 | vk::QueryResultFlags::WAIT;
                    inner
                        .device
                        .get_query_pool_results(context.queries, 0, &mut ticks, flags)
                        .named("reading timestamps")?;
                }
            }
            let period = f64::from(inner.info.timestamp_period);
            timings.extend(self.passes.iter().zip(ticks.chunks_exact(2)).map(|(name, t)| Timing {
                name,
                start: t[0] as f64 * period,
                duration: t[1].saturating_sub(t[0]) as f64 * period,
            }));
        }
        // SAFETY: the fence is signalled and nobody else waits for it.
        unsafe { inner.device.reset_fences(&[context.fence]) }.named("resetting a fence")?;
        // Dropped, it finds nothing in flight.
        self.submitted = false;
        Ok(timings)
    }

    /// True when the device has finished it.
    pub fn is_done(&self) -> bool {
        let inner = self.gpu.inner();
        // SAFETY: a live fence.
        self.context().is_none_or(|c| unsafe { inner.device.get_fence_status(c.fence) }.unwrap_or(true))
    }
}

/// Whether a wait for a fence came to its end: nothing runs after it, or the device is lost and nothing runs any more. After
/// any other failure the work may be in flight still.
fn is_over(waited: ash::prelude::VkResult<()>) -> bool {
    matches!(waited, Ok(()) | Err(vk::Result::ERROR_DEVICE_LOST))
}

impl Drop for Submission<'_> {
    fn drop(&mut self) {
        let inner = self.gpu.inner();
        let context = match self.target.take() {
            Some(Target::Device(context)) => context,
            Some(Target::Books(rehearsal)) => return rehearsal.ended(),
            None => return,
        };
        // What never reached the queue signals no fence: waiting for it would not end.
        if self.submitted {
            // SAFETY: the fence was given to the queue in `start`.
            let waited = unsafe { inner.device.wait_for_fences(&[context.fence], true, u64::MAX) };
            if !is_over(waited) {
                // It may run still: neither the context nor any buffer may be used again or freed before the device is idle.
                lock(&inner.stuck).push(context);
                return;
            }
            // SAFETY: nothing runs that would signal the fence, and nobody else waits for it.
            if unsafe { inner.device.reset_fences(&[context.fence]) }.is_err() {
                // SAFETY: nothing in flight uses the context. With its fence up it is of no use for another submission.
                unsafe { context.destroy(inner) };
                inner.ended();
                return;
            }
        }
        lock(&inner.contexts).push(context);
        inner.ended();
    }
}

/// Where a device was lost, as a part of a sentence: in the first pass without its marker. Without markers, what would tell.
fn place_of_fault(passes: &[&str], markers: Option<&[u8]>) -> String {
    let Some(markers) = markers else {
        let [first, last] = [passes.first(), passes.last()].map(|pass| pass.copied().unwrap_or("none"));
        return format!(
            "in one of {} passes from {first} to {last}; the same command with --trace-faults says in which, and takes longer",
            passes.len()
        );
    };
    let ended = bytemuck::pod_collect_to_vec::<u8, u32>(markers).iter().take_while(|&&marker| marker == 1).count();
    passes.get(ended).map_or_else(|| "behind the last pass that is traced".to_owned(), |pass| format!("in pass {pass}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, testing};

    #[test]
    fn a_wait_that_failed_is_no_end_unless_the_device_is_lost() {
        assert!(is_over(Ok(())) && is_over(Err(vk::Result::ERROR_DEVICE_LOST)));
        for result in
            [vk::Result::ERROR_OUT_OF_HOST_MEMORY, vk::Result::ERROR_OUT_OF_DEVICE_MEMORY, vk::Result::TIMEOUT]
        {
            assert!(!is_over(Err(result)), "{result}");
        }
    }

    /// Its fence was never given to the queue: waiting for it would not end.
    #[test]
    fn what_the_queue_refused_is_not_waited_for() {
        let gpu = testing::gpu();
        for _ in 0..3 {
            let mut recorder = gpu.recorder().expect("a recorder");
            let Some(Target::Device(context)) = recorder.target.take() else { panic!("a device that runs") };
            // SAFETY: in recording, never submitted.
            unsafe { gpu.inner().device.end_command_buffer(context.commands) }.expect("nothing was recorded");
            drop(Submission {
                gpu: &gpu,
                target: Some(Target::Device(context)),
                submitted: false,
                passes: vec![],
                schedule: Schedule::default(),
                commands: vec![],
                differences: vec![],
                trace: BTreeMap::new(),
            });
        }
        let buffer = gpu.upload("words", &[1u32, 2, 3]).expect("the device goes on");
        assert_eq!(gpu.read(&buffer).expect("readable"), [1, 2, 3]);
    }

    #[test]
    fn a_lost_device_is_said_to_be_lost_in_a_pass() {
        let lost = |options: Options| {
            let gpu = testing::gpu_with(options);
            let buffer = gpu.upload("words", &[1u32, 2, 3]).expect("room");
            let mut rec = gpu.recorder().expect("a recorder");
            rec.fill(&buffer, 7);
            rec.zero(&buffer);
            let mut submission = rec.submit().expect("the device takes it");
            gpu.wait_idle().expect("the device runs it");
            submission.passes.push("primitives/scan");
            let said = submission.lost(Err(vk::Result::ERROR_DEVICE_LOST), "").expect_err("lost").to_string();
            submission.wait().expect("it is not");
            said
        };
        let plain = lost(Options::default());
        assert!(
            plain.contains("in one of 3 passes from fill to primitives/scan; ") && plain.contains("--trace-faults")
        );
        let traced = Options { trace_faults: true, ..Options::default() };
        assert_eq!(lost(traced), "the device was lost in pass primitives/scan");
    }
}
