//! What a scene needs, the step, the loop, checkpoints.
