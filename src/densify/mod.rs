//! Statistics, growing and pruning of anchors.
