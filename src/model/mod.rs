//! What is learnt: anchors, decoder, attention; files on disk.

pub mod attention;
pub mod attention_blend;
pub mod attention_select;
