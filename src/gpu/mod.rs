//! The machine room: device, memory, kernels, recorder, barriers, timings.
