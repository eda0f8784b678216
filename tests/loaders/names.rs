//! Every name that a file system takes goes the whole way: prepare, train, eval, export.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use assert_cmd::cargo::cargo_bin;
use gscream_vk::gpu::testing;
use gscream_vk::prepare::{self, Request, Silent};
use gscream_vk::scene::synthetic;

use super::support::{SIZE, copy, load};

/// Names that shells, pages, URLs, paths and lines of text may stumble on. The same letter in two Unicode forms is two.
const ODD: [&str; 22] = [
    "plain",
    "quotes \"double\" and 'single'",
    "<script>alert(1)",
    "<img src=x onerror=y> &amp;",
    "new\nline",
    "tab\tand \u{7f}",
    "-leading",
    "--help",
    " blanks at both ends ",
    "dots...",
    "a.b.png.c",
    "100%25 %2e%2e",
    "NFC \u{e9}",
    "NFD e\u{301}",
    "漢字 😀",
    "back\\slash",
    "$(touch x) `touch y`; touch z",
    "*?[a-z]{1,2}",
    "#hash @at ~tilde",
    "a=b,c:d|e",
    "..two dots",
    "folder 'one'/..folder\ntwo/last",
];

/// `images.bin` with other names of the same views.
fn renamed(model: &[u8], names: &[String]) -> Vec<u8> {
    let (count, mut rest) = model.split_at(8);
    let mut out = count.to_vec();
    for name in names {
        let (pose, after) = rest.split_at(4 + 56 + 4);
        let end = after.iter().position(|byte| *byte == 0).expect("the end of a name");
        out.extend(pose);
        out.extend(name.bytes());
        // The name's end and the number of observations, 0.
        out.extend([0; 9]);
        rest = &after[end + 9..];
    }
    assert!(rest.is_empty());
    out
}

fn program(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(cargo_bin!("gscream-vk"));
    command.args(arguments).current_dir(folder).env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR"));
    command.env_remove("RUST_LOG").output().expect("the program starts")
}

fn succeeds(folder: &Path, arguments: &[&str]) -> String {
    let output = program(folder, arguments);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments:?}: {text}");
    text
}

/// Odd names and those of 255 bytes, of train and of test views, from the photographs to the exported files.
#[test]
fn odd_names_go_the_whole_way() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let at = folder.path();
    // A name that a hidden file would have is not listed: the only one that is left out.
    let odd: Vec<String> = ODD.iter().map(|name| name.trim_start_matches('.').replace("/..", "/")).collect();
    let long = |letter: &str| letter.repeat(251 / letter.len());
    let tests = [odd[2].clone() + " test", long("t"), long("漢"), odd[4].clone() + " test"];
    let all: Vec<String> = odd.iter().cloned().chain([long("i")]).chain(tests.iter().cloned()).collect();
    let [width, height] = SIZE;
    let (train_views, test_views) = (odd.len() as u32 + 1, tests.len() as u32);
    let full = at.join("full");
    let options = synthetic::Options { seed: 1, width, height, train_views, test_views, points: 300 };
    synthetic::write(&full, &options).expect("a writable folder");
    let model = full.join("sparse/0/images.bin");
    let names: Vec<String> = all.iter().map(|name| format!("{name}.png")).collect();
    fs::write(&model, renamed(&fs::read(&model).expect("a model"), &names)).expect("a writable folder");

    // The photographs with their masks, but for the names that are too long for what a scene is to hold.
    let photos = at.join("photos");
    copy(&full.join("sparse"), &photos.join("sparse"));
    let place = |kind: &str, number: String, to: &Path| {
        fs::create_dir_all(to.parent().expect("a folder")).expect("a writable folder");
        fs::copy(full.join(kind).join(number), to).expect("a name that the file system takes");
    };
    for (i, name) in odd.iter().enumerate() {
        for kind in ["images", "masks"] {
            place(kind, format!("train_{i:03}.png"), &photos.join(kind).join(format!("{name}.png")));
        }
    }
    let scene = at.join("a scene");
    let mut request = Request::new(&photos, &scene);
    (request.fit_steps, request.fit_side, request.reference) = (30, 48, Some(odd[1].clone()));
    prepare::prepare(&testing::gpu(), &request, &mut Silent).expect("a scene");

    // In a scene names may be as long as files' names can be.
    let last = odd.len();
    for kind in ["images", "masks"] {
        place(kind, format!("train_{last:03}.png"), &scene.join(kind).join(format!("{}.png", all[last])));
    }
    for (i, name) in tests.iter().enumerate() {
        for kind in ["test_images", "test_masks"] {
            place(kind, format!("test_{i:03}.png"), &scene.join(kind).join(format!("{name}.png")));
        }
    }
    let loaded = load(&scene).expect("a scene");
    let mut wanted = all[..=last].to_vec();
    wanted.sort_unstable();
    assert_eq!(loaded.train.iter().map(|view| view.name.clone()).collect::<Vec<_>>(), wanted);
    let unmasked: Vec<&str> = loaded.train.iter().filter(|v| v.mask.is_none()).map(|v| v.name.as_str()).collect();
    assert!(unmasked.is_empty(), "{unmasked:?}");
    assert_eq!(loaded.test.len(), tests.len());
    assert_eq!(loaded.train[loaded.references[0].view].name, odd[1]);

    succeeds(at, &["train", "a scene", "--out", "a run", "--preset", "demo", "--iterations", "3"]);
    for name in &tests {
        assert!(at.join("a run/test").join(format!("{name}.png")).is_file(), "{name}");
    }
    let metrics = fs::read_to_string(at.join("a run/metrics.json")).expect("figures");
    for name in &tests {
        let quoted = serde_json::to_string(name).expect("a string");
        assert!(metrics.contains(&quoted[1..quoted.len() - 1]), "{name}");
    }
    let page = fs::read_to_string(at.join("a run/index.html")).expect("a page");
    assert!(!page.contains("<script>alert") && !page.contains("<img src=x"), "names are text");
    succeeds(at, &["eval", "a run"]);
    succeeds(at, &["render", "a run", "--out", "renders"]);
    succeeds(at, &["export", "a run"]);
    // Nothing that was begun is left, and nothing ran that a name says.
    let left = walkdir::WalkDir::new(at).into_iter().flatten().filter(|entry| {
        let name = entry.file_name().to_string_lossy();
        name.starts_with('.') && entry.depth() > 0 || ["x", "y", "z"].contains(&&*name)
    });
    let left: Vec<String> = left.map(|entry| entry.path().display().to_string()).collect();
    assert!(left.is_empty(), "{left:?}");
}

/// A photograph whose name leaves no room for what is named after it is refused before anything is written.
#[test]
fn names_without_room_are_refused_first() {
    let folder = super::support::scene();
    let at = folder.path();
    let long = "n".repeat(242);
    fs::rename(at.join("scene/images/train_000.png"), at.join(format!("scene/images/{long}.png"))).expect("a folder");
    let mut request = Request::new(at.join("scene"), at.join("out"));
    request.objects[0].evidence = vec![("train_001".into(), prepare::Evidence::Box([10, 10, 20, 20]))];
    let error = prepare::prepare(&testing::gpu(), &request, &mut Silent).expect_err("no room").to_string();
    assert!(error.contains("its name has 242 bytes without extension") && error.contains("at most 241"), "{error}");
    assert!(!at.join("out").exists());
}
