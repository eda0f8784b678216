//! Settings: as written in TOML, and resolved.
