//! What comes from elsewhere does no harm: links, paths, names, and files of every kind that lie about themselves.

#[cfg(target_os = "linux")]
mod bombs;
mod links;
mod names;
mod support;
