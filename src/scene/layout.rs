//! Which file is what: the folder layouts found in circulation, told apart by the folders they have.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::{Error, Note, Notes, PriorKind, priors};

/// Extensions of pictures and masks, lower case.
pub(crate) const PICTURES: [&str; 3] = ["png", "jpg", "jpeg"];

/// SPIn-NeRF's split of its 100 sorted pictures: the first 40 are test views, and the reference is number 29 of the rest.
const SPIN_PICTURES: usize = 100;
const SPIN_TEST: usize = 40;
const SPIN_REFERENCE: usize = SPIN_TEST + 29;

/// Size of some test masks of SPIn-NeRF's 1008 x 567 scenes: nine rows more than their pictures.
const SPIN_TALL_MASK: ([u32; 2], [u32; 2]) = ([1008, 576], [1008, 567]);

/// One photograph and what belongs to it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Entry {
    /// Path of the picture below its folder, without extension, with `/` between folders.
    pub name: String,
    pub image: PathBuf,
    pub mask: Option<PathBuf>,
    pub prior: Option<(PathBuf, PriorKind)>,
    /// True depth z, of test views.
    pub depth: Option<PathBuf>,
    /// What the object's shadow leaves of the light, of train views.
    pub relight: Option<PathBuf>,
    /// Its hole filled, see [`super::HOLE`].
    pub hole: Option<PathBuf>,
}

/// The inpainted picture of one train view.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ReferenceFiles {
    /// Name of the train view.
    pub name: String,
    pub image: PathBuf,
    pub prior: Option<ReferencePrior>,
}

/// Where the depth prior of the inpainted picture is, and how its kind is known.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ReferencePrior {
    pub path: PathBuf,
    /// Said by the file's name or its folder; otherwise it is found by comparison with the view's own prior.
    pub kind: Option<PriorKind>,
}

/// The files of a scene.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Layout {
    /// One clause: which layout and by what it was recognised.
    pub found: String,
    pub train: Vec<Entry>,
    /// Their priors, if there are any, are of pictures without the object.
    pub test: Vec<Entry>,
    /// Inpainted pictures, sorted by name.
    pub references: Vec<ReferenceFiles>,
    /// The kind of prior that this layout has, if it has any.
    pub kind: Option<PriorKind>,
    pub notes: Notes,
    /// Test masks known to differ in size from their pictures: (mask size, picture size).
    pub tall_test_mask: Option<([u32; 2], [u32; 2])>,
}

/// Files of one folder by name without extension.
type Index = BTreeMap<String, PathBuf>;

/// Finds out how `scene` is laid out and lists its files.
///
/// # Errors
/// No pictures; two files of one name in a folder; `depth/` beside `disparity/`; a reference for no train view.
pub(super) fn find(scene: &Path) -> Result<Layout, Error> {
    let spin_images =
        ["images_4", "images_2", "images_8", "images"].into_iter().find(|name| scene.join(name).join("label").is_dir());
    let gscream =
        ["lama_input", "marigold_output", "images_4/mask_test"].into_iter().find(|name| scene.join(name).is_dir());
    if let Some(by) = gscream {
        gscream_copy(scene, by)
    } else if let Some(images) = spin_images {
        spin_nerf(scene, images)
    } else {
        plain(scene)
    }
}

/// `images` or, where it is missing, a folder of smaller pictures.
fn image_folder<'a>(scene: &Path, names: &[&'a str]) -> Result<&'a str, Error> {
    names
        .iter()
        .copied()
        .find(|name| scene.join(name).is_dir())
        .ok_or_else(|| Error::NoImages { scene: scene.to_path_buf() })
}

fn plain(scene: &Path) -> Result<Layout, Error> {
    let folder = image_folder(scene, &["images", "images_2", "images_4", "images_8"])?;
    let mut passed_over = Notes::default();
    let mut index = |folder: &str, extensions: &[&str]| index(&scene.join(folder), extensions, &mut passed_over);
    let (images, test_images) = (index(folder, &PICTURES)?, index("test_images", &PICTURES)?);
    if images.is_empty() {
        return Err(Error::NoImages { scene: scene.to_path_buf() });
    }
    let (masks, test_masks) = (index("masks", &PICTURES)?, index("test_masks", &PICTURES)?);
    let kind = match (scene.join("depth").is_dir(), scene.join("disparity").is_dir()) {
        (true, true) => {
            let what = "depth/ and disparity/ are both there; keep the one to train with".into();
            return Err(Error::File { path: scene.to_path_buf(), what });
        }
        (true, false) => Some(PriorKind::Depth),
        (false, true) => Some(PriorKind::Disparity),
        (false, false) => None,
    };
    let priors = match kind {
        Some(kind) => index(kind.folder(), &priors::EXTENSIONS)?,
        None => Index::new(),
    };
    let mut train = entries(&images, |name| masks.get(name).cloned(), |name| Some((priors.get(name)?.clone(), kind?)));
    let prior = |name: &String| Some((priors.get(name)?.clone(), kind?));
    let mut test = entries(&test_images, |name| test_masks.get(name).cloned(), prior);
    let depths = index("test_depth", &priors::EXTENSIONS)?;
    test.iter_mut().for_each(|entry| entry.depth = depths.get(&entry.name).cloned());
    let relight = index(super::RELIGHT, &["png"])?;
    let holes = index(super::HOLE, &["png"])?;
    for entry in &mut train {
        entry.relight = relight.get(&entry.name).cloned();
        entry.hole = holes.get(&entry.name).cloned();
    }
    let mut notes = misspelt(scene)?;
    notes.append(&mut passed_over);
    let of_test =
        [("masks", &masks, &images), ("test_masks", &test_masks, &test_images), ("test_depth", &depths, &test_images)];
    for (what, files, pictures) in of_test {
        notes.extend(strays(what, files, pictures));
    }
    if let Some(kind) = kind {
        let all: Index = images.into_iter().chain(test_images).collect();
        notes.extend(strays(kind.folder(), &priors, &all));
    }
    let references = references(&scene.join("reference"), &train)?;
    let found = format!("plain layout: pictures in {folder}/");
    Ok(Layout { found, train, test, references, kind, notes, tall_test_mask: None })
}

/// The folders of the plain layout.
const FOLDERS: [&str; 9] =
    ["images", "masks", "depth", "disparity", "reference", "test_images", "test_masks", "test_depth", "sparse"];

/// Notes on folders that are called nearly like one that is not there.
fn misspelt(scene: &Path) -> Result<Notes, Error> {
    let folders =
        list(scene, &mut Notes::default())?.into_iter().filter(|(path, _)| path.is_dir()).map(|(_, name)| name);
    let near = |name: &str| {
        let missing = FOLDERS.into_iter().filter(|known| !scene.join(known).is_dir());
        missing.map(|known| (strsim::damerau_levenshtein(name, known), known)).filter(|(d, _)| *d <= 2).min()
    };
    let unknown = folders.filter(|name| !FOLDERS.contains(&name.as_str()) && !name.starts_with("images"));
    Ok(unknown
        .filter_map(|name| {
            near(&name).map(|(_, known)| Note::Lost(format!("{name}/ is not read; should it be called {known}/?")))
        })
        .collect())
}

/// A note on files that belong to no picture.
fn strays(what: &str, files: &Index, pictures: &Index) -> Option<Note> {
    let strays: Vec<&str> = files.keys().filter(|name| !pictures.contains_key(*name)).map(String::as_str).collect();
    let first = strays.first()?;
    Some(Note::Lost(format!(
        "{} of {} files in {what}/ belong to no picture and are left out (first: {first})",
        strays.len(),
        files.len()
    )))
}

fn spin_nerf(scene: &Path, folder: &str) -> Result<Layout, Error> {
    let images = scene.join(folder);
    let mut passed_over = Notes::default();
    let masks = index(&images.join("label"), &PICTURES, &mut passed_over)?;
    let test_masks = index(&images.join("test_label"), &PICTURES, &mut passed_over)?;
    let split = spin_split(scene, &images, |name| masks.contains_key(name))?;
    let train = entries(&split.train, |name| masks.get(name).cloned(), |_| None);
    // Test masks are numbered in the order of the sorted pictures.
    let position: BTreeMap<&String, usize> = split.test.keys().enumerate().map(|(i, name)| (name, i + 1)).collect();
    let test_mask =
        |name: &String| test_masks.get(name).or_else(|| test_masks.get(&format!("out_{:05}", position[name]))).cloned();
    let test = entries(&split.test, test_mask, |_| None);
    let (references, note) = spin_reference(scene, &images, &train, split.reference.as_deref())?;
    Ok(Layout {
        found: format!("SPIn-NeRF's layout: pictures in {folder}/, train masks in {folder}/label/"),
        train,
        test,
        references,
        kind: None,
        notes: split.notes.into_iter().chain(note.map(Note::from)).chain(passed_over).collect(),
        tall_test_mask: Some(SPIN_TALL_MASK),
    })
}

fn gscream_copy(scene: &Path, by: &str) -> Result<Layout, Error> {
    let folder = image_folder(scene, &["images_4", "images", "images_2", "images_8"])?;
    let images = scene.join(folder);
    let mut masks = Index::new();
    let mut passed_over = Notes::default();
    let mut index = |folder: PathBuf, extensions: &[&str]| index(&folder, extensions, &mut passed_over);
    for at in [scene.join("lama_input"), images.join("lama_input")] {
        let files = index(at, &PICTURES)?;
        masks
            .extend(files.into_iter().filter_map(|(name, path)| Some((name.strip_suffix("_mask")?.to_string(), path))));
    }
    // Copies that kept SPIn-NeRF's own masks.
    for (name, path) in index(images.join("label"), &PICTURES)? {
        masks.entry(name).or_insert(path);
    }
    let test_masks = index(images.join("mask_test"), &PICTURES)?;
    let numbered = index(images.join("test_label"), &PICTURES)?;
    let depth = index(scene.join("marigold_output/depth_npy"), &["npy"])?;
    let depth: Index =
        depth.into_iter().map(|(name, path)| (name.strip_suffix("_pred").unwrap_or(&name).to_string(), path)).collect();
    let split = spin_split(scene, &images, |name| masks.contains_key(name) && !test_masks.contains_key(name))?;
    let prior = |name: &String| Some((depth.get(name)?.clone(), PriorKind::Depth));
    let train = entries(&split.train, |name| masks.get(name).cloned(), prior);
    let position: BTreeMap<&String, usize> = split.test.keys().enumerate().map(|(i, name)| (name, i + 1)).collect();
    let test_mask =
        |name: &String| test_masks.get(name).or_else(|| numbered.get(&format!("out_{:05}", position[name]))).cloned();
    let test = entries(&split.test, test_mask, prior);
    let (mut references, note) = spin_reference(scene, &images, &train, split.reference.as_deref())?;
    let mut notes: Notes = split.notes.into_iter().chain(note.map(Note::from)).chain(passed_over).collect();
    for files in &mut references {
        let Some((path, kind)) = prior(&files.name).filter(|_| files.prior.is_none()) else { continue };
        notes.push(format!(
            "the reference's depth is {}, as this layout has it (made from the inpainted picture)",
            relative(scene, &path)
        ));
        files.prior = Some(ReferencePrior { path, kind: Some(kind) });
    }
    Ok(Layout {
        found: format!("GScream's copy of SPIn-NeRF: pictures in {folder}/, recognised by {by}/"),
        train,
        test,
        references,
        kind: (!depth.is_empty()).then_some(PriorKind::Depth),
        notes,
        tall_test_mask: Some(SPIN_TALL_MASK),
    })
}

/// SPIn-NeRF's pictures, told apart.
struct Split {
    train: Index,
    test: Index,
    /// Name of the view that the benchmark inpaints.
    reference: Option<String>,
    notes: Notes,
}

/// The benchmark's split by position where all 100 pictures are there, else by which pictures have a train mask.
fn spin_split(scene: &Path, images: &Path, has_train_mask: impl Fn(&str) -> bool) -> Result<Split, Error> {
    let mut notes = Notes::default();
    let mut all = index_flat(images, &PICTURES, &mut notes)?;
    // A single inpainted picture beside the photographs is not one of them.
    all.remove("reference");
    if all.is_empty() {
        return Err(Error::NoImages { scene: scene.to_path_buf() });
    }
    if all.len() == SPIN_PICTURES {
        let reference = all.keys().nth(SPIN_REFERENCE).cloned();
        let first_train = all.keys().nth(SPIN_TEST).cloned().expect("there are 100 names");
        let train = all.split_off(&first_train);
        notes.push(format!("the first {SPIN_TEST} of {SPIN_PICTURES} sorted names are test views"));
        return Ok(Split { train, test: all, reference, notes });
    }
    let count = all.len();
    let (train, test): (Index, Index) = all.into_iter().partition(|(name, _)| has_train_mask(name));
    notes.push(format!(
        "{count} pictures instead of {SPIN_PICTURES}: the {} with a train mask are train views, the others test views",
        train.len()
    ));
    Ok(Split { train, test, reference: None, notes })
}

/// The inpainted picture in a SPIn-NeRF scene, wherever copies keep it, or a note on where it was looked for.
fn spin_reference(
    scene: &Path,
    images: &Path,
    train: &[Entry],
    name: Option<&str>,
) -> Result<(Vec<ReferenceFiles>, Option<String>), Error> {
    for folder in [scene.join("reference"), images.join("reference")] {
        let found = references(&folder, train)?;
        if !found.is_empty() {
            return Ok((found, None));
        }
    }
    let Some(name) = name else {
        return Ok((vec![], Some("no reference/ with one inpainted picture was found".into())));
    };
    let mut candidates = Vec::new();
    for root in [images, scene] {
        for folder in ["lama_images", "lama_output", "inpainted"] {
            // LaMa names its result after the mask file.
            candidates.extend([name.to_string(), format!("{name}_mask")].map(|stem| root.join(folder).join(stem)));
        }
        candidates.push(root.join("reference"));
    }
    let found = candidates.into_iter().find_map(|stem| {
        PICTURES
            .into_iter()
            .flat_map(|e| [e.to_string(), e.to_uppercase()])
            .map(|e| with_extension(&stem, &e))
            .find(|p| p.is_file())
    });
    Ok(match found {
        Some(image) => {
            let note = format!("the reference is {}, taken for the benchmark's view {name}", relative(scene, &image));
            (vec![ReferenceFiles { name: name.to_string(), image, prior: None }], Some(note))
        }
        None => (
            vec![],
            Some(format!(
                "no inpainted picture of the benchmark's reference view was found (looked for reference/{name}.png and lama_images/{name}.png)"
            )),
        ),
    })
}

/// The inpainted pictures in `folder`, their train views and priors; none if there is no such folder or no picture.
///
/// A prior is NAME_depth or NAME_disparity (`.npy`, `.exr`, `.png`), whose kind is said, or NAME (`.npy`, `.exr`).
fn references(folder: &Path, train: &[Entry]) -> Result<Vec<ReferenceFiles>, Error> {
    let kinds = [PriorKind::Depth, PriorKind::Disparity];
    let suffixed = |name: &str| kinds.into_iter().any(|k| name.ends_with(k.suffix()));
    let known = |name: &str| train.iter().any(|e| e.name == name);
    let mut pictures = index(folder, &PICTURES, &mut Notes::default())?;
    pictures.retain(|name, _| known(name) || !suffixed(name));
    let all = pictures.into_iter().map(|(name, image)| {
        if !known(&name) {
            return Err(Error::ReferenceWithoutView { path: image });
        }
        let prior = reference_prior(folder, &name)?;
        Ok(ReferenceFiles { name, image, prior })
    });
    all.collect()
}

/// The prior of the inpainted picture of this name in `folder`, if it has one.
fn reference_prior(folder: &Path, name: &str) -> Result<Option<ReferencePrior>, Error> {
    let kinds = [PriorKind::Depth, PriorKind::Disparity];
    let said = kinds.into_iter().flat_map(|kind| {
        priors::EXTENSIONS.map(|e| (with_extension(&folder.join(format!("{name}{}", kind.suffix())), e), Some(kind)))
    });
    let unsaid = ["npy", "exr"].into_iter().map(|e| (with_extension(&folder.join(name), e), None));
    let found: Vec<_> = said.chain(unsaid).filter(|(path, _)| path.is_file()).collect();
    if let [(first, _), (second, _), ..] = found.as_slice() {
        let what = format!("the reference has a second prior, {}; keep one", second.display());
        return Err(Error::File { path: first.clone(), what });
    }
    Ok(found.into_iter().next().map(|(path, kind)| ReferencePrior { path, kind }))
}

/// What kind of prior a file's name says it is, by NAME_depth or NAME_disparity.
pub(super) fn said_kind(path: &Path) -> Option<PriorKind> {
    let name = path.file_name()?.to_str()?;
    [PriorKind::Depth, PriorKind::Disparity].into_iter().find(|kind| stem(name).ends_with(kind.suffix()))
}

/// Adds an extension to a name that may contain dots.
fn with_extension(stem: &Path, extension: &str) -> PathBuf {
    let mut name = stem.as_os_str().to_os_string();
    name.push(".");
    name.push(extension);
    PathBuf::from(name)
}

fn entries(
    images: &Index,
    mask: impl Fn(&String) -> Option<PathBuf>,
    prior: impl Fn(&String) -> Option<(PathBuf, PriorKind)>,
) -> Vec<Entry> {
    images
        .iter()
        .map(|(name, image)| Entry {
            name: name.clone(),
            image: image.clone(),
            mask: mask(name),
            prior: prior(name),
            depth: None,
            relight: None,
            hole: None,
        })
        .collect()
}

/// A path below the scene, for notes.
pub(super) fn relative(scene: &Path, path: &Path) -> String {
    path.strip_prefix(scene).unwrap_or(path).display().to_string()
}

/// Removes picture extensions: `a.JPG` and COLMAP's mask name `a.jpg.png` both become `a`.
pub(crate) fn stem(name: &str) -> &str {
    let mut stem = name;
    while let Some((rest, extension)) = stem.rsplit_once('.') {
        if rest.is_empty() || !PICTURES.iter().chain(&priors::EXTENSIONS).any(|e| extension.eq_ignore_ascii_case(e)) {
            break;
        }
        stem = rest;
    }
    stem
}

/// Folders within one another that are looked into. Real ones end long before; it is a chain of links that may not.
const DEEPEST: usize = 32;

/// The files of `folder` and of the folders below it that have one of `extensions`. A missing folder is an empty one.
///
/// Links to folders are followed, but no folder is looked into twice, nor one that `folder` lies in: its files would be
/// there several times, under names to which nothing else belongs. `passed_over` gets a sentence on each such link and on
/// names that are no text.
pub(super) fn index(folder: &Path, extensions: &[&str], passed_over: &mut Notes) -> Result<Index, Error> {
    let mut out = Index::new();
    let canonical = |path: &Path| path.canonicalize().map_err(|source| Error::Io { path: path.to_path_buf(), source });
    if !folder.is_dir() {
        return Ok(out);
    }
    let mut seen: BTreeSet<PathBuf> = canonical(folder)?.ancestors().map(Path::to_path_buf).collect();
    // Real folders before links, and links by name, so that it is never a real folder of `folder` that counts as the second.
    let mut folders = vec![(folder.to_path_buf(), String::new())];
    let mut links: BTreeSet<(PathBuf, String)> = BTreeSet::new();
    loop {
        let Some((at, prefix)) = folders.pop() else {
            let Some((path, prefix)) = links.pop_first() else { return Ok(out) };
            let target = canonical(&path)?;
            if prefix.matches('/').count() <= DEEPEST && seen.insert(target.clone()) {
                folders.push((path, prefix));
            } else {
                passed_over.push(Note::Lost(looked_into_already(&path, &target)));
            }
            continue;
        };
        for (path, name) in list(&at, passed_over)? {
            match std::fs::metadata(&path) {
                Ok(what) if what.is_dir() && path.is_symlink() => {
                    links.insert((path, format!("{prefix}{name}/")));
                }
                Ok(what) if what.is_dir() => {
                    let target = canonical(&path)?;
                    if seen.insert(target.clone()) {
                        folders.push((path, format!("{prefix}{name}/")));
                    } else {
                        // It lies behind a link.
                        passed_over.push(Note::Lost(looked_into_already(&path, &target)));
                    }
                }
                // Neither a pipe nor a device is a picture, and reading one may never end.
                Ok(what) if !what.is_file() => {}
                // A link to nothing is refused where it is read.
                _ => insert(&mut out, path, format!("{prefix}{name}"), extensions)?,
            }
        }
    }
}

fn looked_into_already(path: &Path, target: &Path) -> String {
    format!(
        "{} is not looked into: it leads to {}, which is read under another name or holds this folder; remove the link",
        path.display(),
        target.display()
    )
}

/// Like [`index`], without the folders below.
fn index_flat(folder: &Path, extensions: &[&str], passed_over: &mut Notes) -> Result<Index, Error> {
    let mut out = Index::new();
    for (path, name) in list(folder, passed_over)? {
        if path.is_file() {
            insert(&mut out, path, name, extensions)?;
        }
    }
    Ok(out)
}

/// Visible entries of a folder; none if there is no such folder. `passed_over` gets a sentence on names that are no text.
fn list(folder: &Path, passed_over: &mut Notes) -> Result<Vec<(PathBuf, String)>, Error> {
    let failed = |source| Error::Io { path: folder.to_path_buf(), source };
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    let mut out = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        match path.file_name().and_then(|n| n.to_str()).map(str::to_owned) {
            Some(name) if name.starts_with('.') => {}
            Some(name) => out.push((path, name)),
            None => passed_over
                .push(Note::Lost(format!("{} is not read: its name is not UTF-8; rename it", path.display()))),
        }
    }
    Ok(out)
}

fn insert(out: &mut Index, path: PathBuf, name: String, extensions: &[&str]) -> Result<(), Error> {
    let extension = name.rsplit_once('.').map_or("", |(_, e)| e);
    if !extensions.iter().any(|e| extension.eq_ignore_ascii_case(e)) {
        return Ok(());
    }
    let key = stem(&name).to_string();
    if let Some(other) = out.get(&key) {
        let (first, second) = if *other < path { (other.clone(), path) } else { (path, other.clone()) };
        let what = format!("{} has the same name; keep one", second.display());
        return Err(Error::File { path: first, what });
    }
    out.insert(key, path);
    Ok(())
}
