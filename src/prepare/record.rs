//! `prepare.json`: which step made which file from what, and whose a file is.
//!
//! A file is the program's own as long as it has the hash that the record names; whatever else lies in the folder is the
//! user's and is never written over. A step whose inputs hash to the same value as last time is skipped.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::{self, Cursor};
use std::path::{Component, Path, PathBuf};

use crate::atomic::{self, AtomicWriteFile, shortened};
use image::{GrayImage, ImageBuffer, ImageFormat, PixelWithColorType, RgbImage};
use serde::{Deserialize, Serialize};
use tempfile::TempDir;

use super::{Error, Step};
use crate::folder;
use crate::scene::npy;

/// The record's file within a prepared scene.
pub const RECORD: &str = "prepare.json";

/// A file of the program's own.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileRecord {
    /// blake3 of its bytes.
    pub hash: String,
    /// What it was made from, in words.
    pub from: String,
}

/// A step that has ended.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StepRecord {
    /// blake3 of everything that the step read.
    pub inputs: String,
    /// Its files by their path below the scene.
    pub files: BTreeMap<String, FileRecord>,
    /// One line each: what was found out.
    pub notes: Vec<String>,
    /// Figures by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub figures: BTreeMap<String, f64>,
}

/// The contents of `prepare.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// Version of the program that wrote it last.
    pub version: String,
    /// Steps by name.
    pub steps: BTreeMap<String, StepRecord>,
    /// What was repainted by hand, in its order.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub repaints: Vec<Repainted>,
    /// Hashes of files that a step was about to write when this was written: they are the program's own, too.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub pending: BTreeMap<String, String>,
}

/// A repaint as the record has it; its brush lies in `prepare/repaint/`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Repainted {
    /// The photograph that was brushed over.
    pub view: String,
    /// From where the patch is, pixels from what it is put onto; none where it was filled anew.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub offset: Option<[i32; 2]>,
}

/// blake3 of parts, each with its length, as hexadecimal digits.
#[derive(Default)]
pub struct Inputs(blake3::Hasher);

impl Inputs {
    /// Adds a part.
    pub fn with(mut self, part: impl AsRef<[u8]>) -> Self {
        let part = part.as_ref();
        self.0.update(&(part.len() as u64).to_le_bytes());
        self.0.update(part);
        self
    }

    /// The hash of all parts and of the program's version, by which steps may change.
    pub fn finish(self) -> String {
        self.with(env!("CARGO_PKG_VERSION")).0.finalize().to_hex().to_string()
    }
}

/// blake3 of a file as hexadecimal digits.
///
/// # Errors
/// A file that cannot be read.
pub fn hash(path: &Path) -> Result<String, Error> {
    let failed = |source| Error::Io { path: path.to_owned(), source };
    let mut hasher = blake3::Hasher::new();
    io::copy(&mut File::open(path).map_err(failed)?, &mut hasher).map_err(failed)?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// A path below a scene as records have it: its components with `/` between them on every platform. Nothing for a path
/// that leads elsewhere, with `..`, a root or a drive in it.
pub fn key(path: &Path) -> Option<String> {
    joined(path.components())
}

/// Whether a path as text leads below the folder that it is joined to.
fn is_below(path: &str) -> bool {
    key(Path::new(path)).is_some()
}

/// See [`key`].
fn joined<'a>(components: impl Iterator<Item = Component<'a>>) -> Option<String> {
    let normal = |component| match component {
        Component::Normal(name) => Some(name.to_string_lossy()),
        Component::Prefix(_) | Component::RootDir | Component::CurDir | Component::ParentDir => None,
    };
    let names: Vec<_> = components.map(normal).collect::<Option<_>>()?;
    (!names.is_empty()).then(|| names.join("/"))
}

/// A picture as a PNG file.
pub(super) fn png<P>(picture: &ImageBuffer<P, Vec<u8>>) -> Vec<u8>
where
    P: PixelWithColorType<Subpixel = u8>,
{
    let mut bytes = Cursor::new(vec![]);
    picture.write_to(&mut bytes, ImageFormat::Png).expect("a picture is encoded into memory");
    bytes.into_inner()
}

/// What a step writes, all of it at once.
#[derive(Default)]
pub struct Batch {
    files: BTreeMap<String, (Content, String)>,
    /// See [`StepRecord::notes`].
    pub notes: Vec<String>,
    /// See [`StepRecord::figures`].
    pub figures: BTreeMap<String, f64>,
    /// Where large pictures wait.
    aside: Option<TempDir>,
}

enum Content {
    Bytes(Vec<u8>),
    Copy(PathBuf),
}

impl Batch {
    /// A file of these bytes at a path below the scene, and what it was made from.
    pub fn bytes(&mut self, path: impl Into<String>, bytes: Vec<u8>, from: impl Into<String>) {
        self.files.insert(path.into(), (Content::Bytes(bytes), from.into()));
    }

    /// A copy of a file.
    pub fn copy(&mut self, path: impl Into<String>, source: &Path, from: impl Into<String>) {
        self.files.insert(path.into(), (Content::Copy(source.to_owned()), from.into()));
    }

    /// A picture as PNG.
    pub fn rgb(&mut self, path: impl Into<String>, picture: &RgbImage, from: impl Into<String>) {
        self.bytes(path, png(picture), from);
    }

    /// A picture with alpha as PNG.
    pub fn rgba(&mut self, path: impl Into<String>, picture: &image::RgbaImage, from: impl Into<String>) {
        self.bytes(path, png(picture), from);
    }

    /// A picture as PNG, one of many large ones: until it is written it waits on disk.
    ///
    /// # Errors
    /// When there is no room for it.
    pub fn rgb_aside(
        &mut self,
        path: impl Into<String>,
        picture: &RgbImage,
        from: impl Into<String>,
    ) -> Result<(), Error> {
        let failed = |source| Error::Io { path: std::env::temp_dir(), source };
        if self.aside.is_none() {
            self.aside = Some(tempfile::tempdir().map_err(failed)?);
        }
        let folder = self.aside.as_ref().expect("it was just made").path();
        let file = folder.join(format!("{}.png", self.files.len()));
        let written = picture.save(&file);
        written.map_err(|source| Error::Scene(crate::scene::Error::Picture { path: file.clone(), source }))?;
        self.copy(path, &file, from);
        Ok(())
    }

    /// A mask as PNG.
    pub fn gray(&mut self, path: impl Into<String>, picture: &GrayImage, from: impl Into<String>) {
        self.bytes(path, png(picture), from);
    }

    /// The BLAKE3 hash of a file of these bytes, as hexadecimal digits; nothing for a copy.
    pub fn hash_of(&self, path: &str) -> Option<String> {
        match &self.files.get(path)?.0 {
            Content::Bytes(bytes) => Some(blake3::hash(bytes).to_hex().to_string()),
            Content::Copy(_) => None,
        }
    }

    /// A float32 map (row-major, width and height in `size`) as NumPy file.
    pub fn npy(&mut self, path: impl Into<String>, size: [u32; 2], values: Vec<f32>, from: impl Into<String>) {
        self.bytes(path, npy::encode(&values, size), from);
    }
}

/// A scene's folder and its record.
pub struct Folder {
    root: PathBuf,
    record: Record,
}

/// The lines that the steps of `prepare` left about a scene: where its reference comes from, among others. Empty for a
/// scene that `prepare` did not make.
pub fn notes(scene: &Path) -> Vec<String> {
    let steps = ended(scene);
    let steps = Step::ALL.iter().filter_map(|step| steps.get(step.name()));
    steps.flat_map(|step| step.notes.clone()).collect()
}

/// The steps of `prepare` that have ended in a scene, by name; none where it did not make the scene.
pub fn ended(scene: &Path) -> BTreeMap<String, StepRecord> {
    if !scene.join(RECORD).is_file() {
        return BTreeMap::new();
    }
    Folder::open(scene).map_or_else(|_| BTreeMap::new(), |folder| folder.record.steps)
}

impl Folder {
    /// Opens the folder, making it if it is missing.
    ///
    /// # Errors
    /// A folder that cannot be made; a record that cannot be read.
    pub fn open(root: &Path) -> Result<Self, Error> {
        std::fs::create_dir_all(root).map_err(|source| Error::Io { path: root.to_owned(), source })?;
        let path = root.join(RECORD);
        let record: Record = match std::fs::read(&path) {
            Ok(text) => serde_json::from_slice(&text).map_err(|error| {
                let what = format!("not a record of prepare ({error}); move it away to start again");
                Error::File { path: path.clone(), what }
            })?,
            Err(error) if error.kind() == io::ErrorKind::NotFound => Record::default(),
            Err(source) => return Err(Error::Io { path, source }),
        };
        // A record may come with a scene from anywhere, and files that it names are removed.
        let mut named = record.steps.values().flat_map(|step| step.files.keys()).chain(record.pending.keys());
        if let Some(outside) = named.find(|file| !is_below(file)) {
            let what =
                format!("it names {outside:?}, which is no path below the scene; move this file away to start again");
            return Err(Error::File { path, what });
        }
        Ok(Self { root: root.to_owned(), record })
    }

    /// Removes what a killed `prepare` left of files that it was writing. The caller holds the folder's lock.
    pub fn sweep(&self) {
        let recorded = self.record.steps.values().flat_map(|step| step.files.keys()).chain(self.record.pending.keys());
        // A record may be somebody else's: nothing outside the scene is looked at.
        let normal = |path: &&Path| path.components().all(|part| matches!(part, Component::Normal(_)));
        let mut own: BTreeMap<PathBuf, BTreeSet<OsString>> = BTreeMap::new();
        for path in recorded.map(Path::new).filter(normal).chain([Path::new(RECORD)]) {
            if let (Some(folder), Some(name)) = (path.parent(), path.file_name()) {
                own.entry(self.root.join(folder)).or_default().insert(shortened(name));
            }
        }
        for (folder, names) in own {
            folder::sweep(&folder, |name| names.contains(OsStr::new(name)));
        }
    }

    /// The folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// What is known of it.
    pub fn record(&self) -> &Record {
        &self.record
    }

    /// The files that a step has made, by their path below the scene.
    pub fn made(&self, step: Step) -> impl Iterator<Item = (&String, &FileRecord)> {
        self.record.steps.get(step.name()).into_iter().flat_map(|step| &step.files)
    }

    /// Has these repaints from now on.
    ///
    /// # Errors
    /// A record that cannot be written.
    pub fn repaint(&mut self, repaints: Vec<Repainted>) -> Result<(), Error> {
        self.record.repaints = repaints;
        self.save()
    }

    /// Whether a path below the scene holds a file that the program has not written, or that was changed since.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn is_users(&self, path: &str) -> Result<bool, Error> {
        let file = self.root.join(path);
        if !file.exists() {
            return Ok(false);
        }
        let found = hash(&file)?;
        let recorded = self.record.steps.values().filter_map(|step| step.files.get(path)).map(|file| &file.hash);
        Ok(!recorded.chain(self.record.pending.get(path)).any(|hash| *hash == found))
    }

    /// Whether a file is there and lies in the scene's folder itself, not behind a link that leads out of it.
    fn holds(&self, file: &Path) -> bool {
        let folder = file.parent().and_then(|folder| folder.canonicalize().ok());
        let root = self.root.canonicalize();
        file.exists() && folder.is_some_and(|folder| root.is_ok_and(|root| folder.starts_with(root)))
    }

    /// Whether what is written at a path below the scene would come to lie outside of it, behind a link to a folder there.
    fn leads_elsewhere(&self, path: &str) -> bool {
        let target = self.root.join(path);
        let there = target.ancestors().skip(1).find(|folder| folder.symlink_metadata().is_ok());
        let [root, there] = [Some(self.root.as_path()), there].map(|folder| folder.and_then(|f| f.canonicalize().ok()));
        !root.zip(there).is_some_and(|(root, there)| there.starts_with(root))
    }

    /// Whether a step has nothing to do: its inputs are those of last time and its files are there.
    pub fn is_fresh(&self, step: &str, inputs: &str) -> bool {
        self.record.steps.get(step).is_some_and(|record| {
            record.inputs == inputs && record.files.keys().all(|path| self.root.join(path).is_file())
        })
    }

    /// Writes what a step made, each file whole or not at all, and takes away what it made before and no more. A file of the
    /// user's stays as it is. Returns the paths that were kept for that reason.
    ///
    /// # Errors
    /// A path that does not lead below the scene, before anything is written; a file that cannot be read or written: the
    /// files written before stay, and are written over the next time.
    pub fn write(&mut self, step: &str, inputs: String, batch: Batch) -> Result<Vec<String>, Error> {
        let Batch { files, notes, figures, aside: _aside } = batch;
        if let Some(outside) = files.keys().find(|path| !is_below(path)) {
            let what =
                format!("the step {step} would write {outside:?}, which is no path below the scene; rename its source");
            return Err(Error::File { path: self.root.clone(), what });
        }
        if let Some(elsewhere) = files.keys().find(|path| self.leads_elsewhere(path)) {
            let what = format!(
                "the step {step} would write {elsewhere:?} behind a link that leads out of the scene; put a folder in the link's place"
            );
            return Err(Error::File { path: self.root.clone(), what });
        }
        let mut kept = vec![];
        let mut new = StepRecord { inputs, files: BTreeMap::new(), notes, figures };
        let mut todo = vec![];
        for (path, (content, from)) in files {
            let hash = match &content {
                Content::Bytes(bytes) => blake3::hash(bytes).to_hex().to_string(),
                Content::Copy(source) => hash(source)?,
            };
            if self.is_users(&path)? {
                // The same bytes may have been put there by hand: they stay, and stay the user's.
                kept.push(path);
                continue;
            }
            new.files.insert(path.clone(), FileRecord { hash, from });
            todo.push((path, content));
        }
        self.record.pending = new.files.iter().map(|(path, file)| (path.clone(), file.hash.clone())).collect();
        self.save()?;
        for (path, content) in todo {
            let target = self.root.join(&path);
            let copy = |source: &Path| {
                std::fs::create_dir_all(target.parent().unwrap_or(&self.root))?;
                let mut file = AtomicWriteFile::open(&target)?;
                io::copy(&mut File::open(source)?, &mut file)?;
                file.commit()
            };
            let written = match &content {
                Content::Bytes(bytes) => atomic::write_below(&target, bytes),
                Content::Copy(source) => copy(source),
            };
            written.map_err(|source| Error::Io { path: target.clone(), source })?;
        }
        let old: BTreeSet<String> =
            self.record.steps.get(step).map(|old| old.files.keys().cloned().collect()).unwrap_or_default();
        for path in old.into_iter().filter(|path| !new.files.contains_key(path)) {
            let file = self.root.join(&path);
            if self.holds(&file) && !self.is_users(&path)? {
                std::fs::remove_file(&file).map_err(|source| Error::Io { path: file.clone(), source })?;
                // A folder that is empty now says nothing any more; one that is not stays.
                if let Some(folder) = file.parent().filter(|folder| *folder != self.root) {
                    let _ = std::fs::remove_dir(folder);
                }
            }
        }
        self.record.steps.insert(step.to_owned(), new);
        self.record.pending.clear();
        self.save()?;
        Ok(kept)
    }

    fn save(&mut self) -> Result<(), Error> {
        env!("CARGO_PKG_VERSION").clone_into(&mut self.record.version);
        let path = self.root.join(RECORD);
        atomic::write_json(&path, &self.record).map_err(|source| Error::Io { path: path.clone(), source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn batch(files: &[(&str, &str)]) -> Batch {
        let mut batch = Batch::default();
        for (path, text) in files {
            batch.bytes(*path, text.as_bytes().to_vec(), "a test");
        }
        batch
    }

    #[test]
    fn steps_are_skipped_and_the_users_files_stay() {
        let dir = tempfile::tempdir().unwrap();
        let read = |path: &str| std::fs::read_to_string(dir.path().join(path)).unwrap();
        let mut folder = Folder::open(dir.path()).unwrap();
        assert!(!folder.is_fresh("masks", "1"));
        assert!(
            folder.write("masks", "1".into(), batch(&[("masks/a", "one"), ("masks/b", "two")])).unwrap().is_empty()
        );
        assert!(folder.is_fresh("masks", "1") && !folder.is_fresh("masks", "2"));

        // Another program run sees the same.
        let mut folder = Folder::open(dir.path()).unwrap();
        assert!(folder.is_fresh("masks", "1") && !folder.is_users("masks/a").unwrap());

        // A file that was changed by hand is the user's, and so is one that was never the program's.
        std::fs::write(dir.path().join("masks/a"), "mine").unwrap();
        std::fs::write(dir.path().join("masks/c"), "mine, too").unwrap();
        assert!(folder.is_users("masks/a").unwrap() && folder.is_users("masks/c").unwrap());
        let kept = folder.write("masks", "2".into(), batch(&[("masks/a", "x"), ("masks/c", "y")])).unwrap();
        assert_eq!(kept, ["masks/a", "masks/c"]);
        assert_eq!((read("masks/a").as_str(), read("masks/c").as_str()), ("mine", "mine, too"));
        // What the step made before and does not make any more is gone.
        assert!(!dir.path().join("masks/b").exists());

        // A file that is missing is made again.
        folder.write("masks", "3".into(), batch(&[("masks/d", "four")])).unwrap();
        std::fs::remove_file(dir.path().join("masks/d")).unwrap();
        assert!(!folder.is_fresh("masks", "3"));
    }

    /// A record keeps `/` between folders where the platform has something else.
    #[test]
    fn keys_are_the_same_on_every_platform() {
        let normal = |name: &'static str| Component::Normal(name.as_ref());
        assert_eq!(joined([normal("masks"), normal("a.png")].into_iter()).as_deref(), Some("masks/a.png"));
        assert_eq!(key(&["masks", "b", "a.png"].iter().collect::<PathBuf>()).as_deref(), Some("masks/b/a.png"));
        for elsewhere in [Component::ParentDir, Component::RootDir] {
            assert_eq!(joined([normal("masks"), elsewhere, normal("a.png")].into_iter()), None);
        }
        assert_eq!(key(Path::new("")), None);
    }

    /// A scene that somebody gives away names files elsewhere in its record, with their hashes: they stay.
    #[test]
    fn a_foreign_record_removes_nothing_elsewhere() {
        let dir = tempfile::tempdir().unwrap();
        let (scene, precious) = (dir.path().join("scene"), dir.path().join("precious"));
        std::fs::create_dir(&scene).unwrap();
        std::fs::write(&precious, "photographs").unwrap();
        let hash = blake3::hash(b"photographs").to_hex().to_string();
        for (path, pending) in [("../precious", false), (precious.to_str().unwrap(), false), ("a/../../b", true)] {
            let mut record = Record::default();
            if pending {
                record.pending.insert(path.into(), hash.clone());
            } else {
                let file = FileRecord { hash: hash.clone(), from: "a test".into() };
                record.steps.entry("masks".into()).or_default().files.insert(path.into(), file);
            }
            std::fs::write(scene.join(RECORD), serde_json::to_string(&record).unwrap()).unwrap();
            let refusal = Folder::open(&scene).and_then(|mut folder| folder.write("masks", "1".into(), batch(&[])));
            let error = refusal.expect_err("a path elsewhere").to_string();
            assert!(error.contains("which is no path below the scene"), "{error}");
            assert!(precious.exists());
        }
    }

    /// A link to a folder elsewhere in such a scene does not help either.
    #[cfg(unix)]
    #[test]
    fn nothing_is_removed_behind_a_link() {
        let dir = tempfile::tempdir().unwrap();
        let (scene, home) = (dir.path().join("scene"), dir.path().join("home"));
        std::fs::create_dir_all(&home).unwrap();
        let mut folder = Folder::open(&scene).unwrap();
        folder.write("masks", "1".into(), batch(&[("masks/a", "one"), ("kept/a", "one")])).unwrap();
        std::fs::write(home.join("a"), "one").unwrap();
        std::fs::remove_dir_all(scene.join("masks")).unwrap();
        std::os::unix::fs::symlink(&home, scene.join("masks")).unwrap();
        folder.write("masks", "2".into(), batch(&[])).unwrap();
        assert!(home.join("a").exists() && !scene.join("kept").exists());
    }

    /// Nor is anything written there, whatever the record says of it.
    #[cfg(unix)]
    #[test]
    fn nothing_is_written_behind_a_link() {
        let dir = tempfile::tempdir().unwrap();
        let (scene, home) = (dir.path().join("scene"), dir.path().join("home"));
        std::fs::create_dir_all(&home).unwrap();
        let mut folder = Folder::open(&scene).unwrap();
        std::fs::write(home.join("a"), "precious").unwrap();
        folder.record.pending.insert("masks/a".into(), blake3::hash(b"precious").to_hex().to_string());
        for (link, to) in [("masks", home.clone()), ("gone", dir.path().join("none"))] {
            std::os::unix::fs::symlink(to, scene.join(link)).unwrap();
        }
        for path in ["masks/a", "masks/b", "masks/c/d", "gone/a"] {
            let error = folder.write("masks", "1".into(), batch(&[("kept/a", "x"), (path, "y")])).unwrap_err();
            assert!(error.to_string().contains("behind a link"), "{error}");
        }
        assert_eq!(std::fs::read_to_string(home.join("a")).unwrap(), "precious");
        assert!(!home.join("b").exists() && !home.join("c").exists() && !scene.join("kept").exists());
        // A link within the scene is the user's own business.
        std::fs::create_dir(scene.join("large")).unwrap();
        std::os::unix::fs::symlink("large", scene.join("small")).unwrap();
        folder.write("masks", "1".into(), batch(&[("small/a", "x")])).unwrap();
        assert!(scene.join("large/a").exists());
    }

    #[test]
    fn what_would_be_written_elsewhere_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let mut folder = Folder::open(&dir.path().join("scene")).unwrap();
        for path in ["../a", "/a", "images/../../a", "."] {
            let error = folder.write("poses", "1".into(), batch(&[("images/b", "x"), (path, "y")])).unwrap_err();
            assert!(error.to_string().contains("no path below the scene"), "{error}");
        }
        assert!(!dir.path().join("a").exists() && !dir.path().join("scene/images").exists());
    }

    /// A run that was killed between its files and its record leaves files of its own, not the user's.
    #[test]
    fn a_killed_step_is_repeated() {
        let dir = tempfile::tempdir().unwrap();
        let mut folder = Folder::open(dir.path()).unwrap();
        folder.record.pending.insert("a".into(), blake3::hash(b"half").to_hex().to_string());
        folder.save().unwrap();
        std::fs::write(dir.path().join("a"), "half").unwrap();
        let mut folder = Folder::open(dir.path()).unwrap();
        assert!(folder.write("fit", "1".into(), batch(&[("a", "whole")])).unwrap().is_empty());
        assert_eq!(std::fs::read(dir.path().join("a")).unwrap(), b"whole");
    }

    #[test]
    fn what_a_killed_step_was_writing_is_swept() {
        let dir = tempfile::tempdir().unwrap();
        let mut folder = Folder::open(&dir.path().join("scene")).unwrap();
        folder.write("masks", "1".into(), batch(&[("masks/a.png", "one")])).unwrap();
        folder.record.pending.insert("depth/b.npy".into(), String::new());
        folder.record.pending.insert("../c".into(), String::new());
        let left = ["scene/masks/.a.png.a1B2c3", "scene/depth/.b.npy.ABCDEF", "scene/.prepare.json.123456"];
        let others = ["scene/masks/.z.png.a1B2c3", "scene/masks/.a.png.swp", ".c.a1B2c3"];
        std::fs::create_dir(dir.path().join("scene/depth")).unwrap();
        for path in left.iter().chain(&others) {
            std::fs::write(dir.path().join(path), "").unwrap();
        }
        folder.sweep();
        assert!(left.iter().all(|path| !dir.path().join(path).exists()), "left by a killed step");
        assert!(others.iter().all(|path| dir.path().join(path).exists()), "nobody's, or outside the scene");
        assert!(dir.path().join("scene/masks/a.png").exists());
    }

    #[test]
    fn a_record_that_is_none_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join(RECORD), "[]").unwrap();
        let error = Folder::open(dir.path()).err().unwrap().to_string();
        assert!(error.contains("prepare.json: not a record of prepare"), "{error}");
    }
}
