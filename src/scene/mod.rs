//! What was captured: cameras, photographs, masks, depth priors, points.
