//! What is learnt: anchors, decoder, attention; files on disk.

pub mod attention;
