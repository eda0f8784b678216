//! What was said of a scene already.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

static SAID: Mutex<BTreeSet<(PathBuf, String)>> = Mutex::new(BTreeSet::new());

/// Whether this is the first time that the program says these words of a scene: notes are said once, however many parts of a
/// command read the scene.
pub fn is_new(scene: &Path, words: &str) -> bool {
    let scene = scene.canonicalize().unwrap_or_else(|_| scene.to_owned());
    SAID.lock().unwrap_or_else(PoisonError::into_inner).insert((scene, words.to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_of_a_scene_are_new_once() {
        let folder = tempfile::tempdir().expect("a folder");
        let [scene, other] = ["scene", "other"].map(|name| folder.path().join(name));
        std::fs::create_dir(&scene).expect("writable");
        let again = folder.path().join("scene/../scene");
        assert!(is_new(&scene, "a note") && !is_new(&scene, "a note") && !is_new(&again, "a note"));
        assert!(is_new(&scene, "another") && is_new(&other, "a note"));
    }
}
