use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};

use image::{Luma, Rgb};
use serde_json::{Value, json};

use super::repaint::Repainting;
use super::*;
use crate::scene::Camera;
use crate::scene::doctor::iou;
use crate::view::server::{self, Secret};

const SIZE: [u32; 2] = [160, 120];

/// A textured disc on a textured ground.
fn is_object(x: u32, y: u32) -> bool {
    (f64::from(x) - 70.0).powi(2) + (f64::from(y) - 60.0).powi(2) < 26.0f64.powi(2)
}

fn photograph() -> RgbImage {
    RgbImage::from_fn(SIZE[0], SIZE[1], |x, y| {
        let noise = ((x * 7 + y * 13) % 17) as u8;
        Rgb(if is_object(x, y) { [170 + noise, 60 + noise, 40] } else { [60 + noise, 90 + noise, 120] })
    })
}

fn truth() -> GrayImage {
    GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| Luma([if is_object(x, y) { 255 } else { 0 }]))
}

struct Place {
    folder: tempfile::TempDir,
    photographs: BTreeMap<String, PathBuf>,
}

impl Place {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let mut photographs = BTreeMap::new();
        for name in ["a", "b", "c & <d>"] {
            let path = folder.path().join(format!("{name}.png"));
            photograph().save(&path).unwrap();
            photographs.insert(name.to_owned(), path);
        }
        Self { folder, photographs }
    }

    fn objects(&self) -> PathBuf {
        self.folder.path().join("objects")
    }

    fn open(&self) -> Arc<Session> {
        Session::open("place", &self.photographs, &self.objects(), &BTreeMap::new()).unwrap()
    }
}

/// The secret of the tests' servers.
const DOOR: &str = "door";

fn serve(session: &Arc<Session>) -> SocketAddr {
    let listener = server::bind(([127, 0, 0, 1], 0).into()).unwrap();
    let address = listener.local_addr().unwrap();
    let site = session.clone();
    std::thread::spawn(move || server::serve(&listener, &site, &Secret::known(DOOR)));
    address
}

/// Status and body of what comes back.
fn ask(address: SocketAddr, request: &[u8]) -> (u32, Vec<u8>) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    stream.write_all(request).unwrap();
    let mut answer = vec![];
    stream.read_to_end(&mut answer).unwrap();
    let status = std::str::from_utf8(&answer[9..12]).unwrap().parse().unwrap();
    let body = answer.windows(4).position(|window| window == b"\r\n\r\n").unwrap() + 4;
    (status, answer[body..].to_vec())
}

fn get(address: SocketAddr, path: &str) -> (u32, Vec<u8>) {
    ask(address, format!("GET /{DOOR}{path} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes())
}

fn post_as(address: SocketAddr, path: &str, fields: &str, body: &str) -> (u32, String) {
    let head =
        format!("POST /{DOOR}{path} HTTP/1.1\r\nHost: localhost\r\n{fields}Content-Length: {}\r\n\r\n", body.len());
    let (status, text) = ask(address, &[head.as_bytes(), body.as_bytes()].concat());
    (status, String::from_utf8(text).unwrap())
}

fn post(address: SocketAddr, path: &str, body: &str) -> (u32, String) {
    post_as(address, path, "Content-Type: application/json\r\n", body)
}

fn state(address: SocketAddr) -> Value {
    serde_json::from_slice(&get(address, "/api/state").1).unwrap()
}

const CLICK: &str = r#"{"view":"a","marks":[{"kind":"object","at":[0.44,0.5]}]}"#;

#[test]
fn the_page_and_its_pictures_are_there_and_name_nothing_but_views() {
    let place = Place::new();
    let session = place.open();
    let address = serve(&session);
    let (status, page) = get(address, "/");
    let page = String::from_utf8(page).unwrap();
    assert!(status == 200 && !page.contains(DOOR));
    for path in [
        "/page.js",
        "/repaint.js",
        "/compare.js",
        "/page.css",
        "/photo.jpg?view=a",
        "/thumb.jpg?view=c%20%26%20%3Cd%3E",
    ] {
        assert_eq!(get(address, path).0, 200, "{path}");
    }
    // Nothing is looked up by a path, and there is nothing yet to download or to look at.
    for path in [
        "/photo.jpg?view=../a",
        "/photo.jpg?view=..%2Fa",
        "/photo.jpg?view=%2Fetc%2Fpasswd",
        "/photo.jpg?view=a%00",
        "/photo.jpg?view=%",
        "/photo.jpg",
        "/overlay.png?view=a",
        "/download/../a.png",
        "/download/scene.ply",
        "/live/state.json",
        "/result/",
        "/a.png",
    ] {
        assert_eq!(get(address, path).0, 404, "{path}");
    }
    assert_eq!(ask(address, b"GET /door/ HTTP/1.1\r\nHost: evil.example\r\n\r\n").0, 421);
    let names: Vec<_> = state(address)["views"].as_array().unwrap().iter().map(|view| view["name"].clone()).collect();
    assert_eq!(names, ["a", "b", "c & <d>"]);
}

/// A second client that has only the port learns nothing and changes nothing; nor does another site's page with the secret.
#[test]
fn nothing_is_told_or_changed_without_the_secret() {
    let place = Place::new();
    let session = place.open();
    let address = serve(&session);
    let json = "Content-Type: application/json\r\n";
    for path in
        ["/", "/api/state", "/photo.jpg?view=a", "/download/scene.ply", "/door", "/doors/", "/live/", "/result/"]
    {
        let (status, told) = ask(address, format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes());
        assert_eq!(status, 403, "{path}");
        let told = String::from_utf8(told).unwrap();
        assert!(["place", "view", DOOR, "Remove"].iter().all(|word| !told.contains(word)), "{told}");
    }
    let length = CLICK.len();
    let begun = format!("HTTP/1.1\r\nHost: localhost\r\n{json}Content-Length: {length}\r\n\r\n{CLICK}");
    for path in ["/api/marks", "/0/api/marks", "//api/marks"] {
        assert_eq!(ask(address, format!("POST {path} {begun}").as_bytes()).0, 403, "{path}");
    }
    let send = |fields: &str| post_as(address, "/api/marks", fields, CLICK).0;
    assert_eq!(send(&format!("{json}Origin: http://evil.example\r\n")), 403);
    assert_eq!(send(&format!("{json}Origin: null\r\n")), 403);
    assert_eq!(send(&format!("{json}Sec-Fetch-Site: cross-site\r\n")), 403);
    // What a form of another site can send.
    assert_eq!(send("Content-Type: text/plain\r\n"), 415);
    assert_eq!(send(""), 415);
    let foreign = format!("POST /{DOOR}/api/marks HTTP/1.1\r\nHost: evil.example\r\n{json}Content-Length: 0\r\n\r\n");
    assert_eq!(ask(address, foreign.as_bytes()).0, 421);
    let endless = format!("POST /{DOOR}/api/marks HTTP/1.1\r\nHost: localhost\r\n{json}\r\n");
    assert_eq!(ask(address, endless.as_bytes()).0, 411);
    assert_eq!(get(address, "/api/remove").0, 404);
    assert_eq!(ask(address, b"PUT /door/ HTTP/1.1\r\nHost: localhost\r\n\r\n").0, 405);
    assert_eq!(state(address)["revision"], 1);
    assert!(!place.objects().exists());
    assert_eq!(send(&format!("{json}Origin: http://localhost:{}\r\n", address.port())), 200);
    assert_eq!(state(address)["revision"], 2);
}

/// A photograph that is gone, a folder that cannot be written: the marks are those of before, and the page is told why.
#[test]
fn a_mark_that_fails_leaves_things_as_they_were() {
    let place = Place::new();
    let session = place.open();
    let address = serve(&session);
    assert_eq!(post(address, "/api/marks", CLICK).0, 200);
    let before = state(address);
    let [mask, marks] = ["a.png", "a.json"].map(|name| std::fs::read(place.objects().join(name)).unwrap());
    // A file where the folder was.
    let aside = place.folder.path().join("aside");
    std::fs::rename(place.objects(), &aside).unwrap();
    std::fs::write(place.objects(), "").unwrap();
    let further = r#"{"view":"a","marks":[{"kind":"object","at":[0.44,0.5]},{"kind":"background","at":[0.1,0.1]}]}"#;
    for view in ["a", "b"] {
        let (status, why) = post(address, "/api/marks", &further.replace("\"a\"", &format!("\"{view}\"")));
        assert!(status == 503 && why.contains("objects: cannot be written"), "{status} {why}");
    }
    assert_eq!(state(address)["views"][0]["objects"][0]["marks"], before["views"][0]["objects"][0]["marks"]);
    assert_eq!(state(address)["views"][1], before["views"][1]);
    std::fs::remove_file(place.objects()).unwrap();
    std::fs::rename(&aside, place.objects()).unwrap();
    // The marks cannot be written, the mask can.
    std::fs::remove_file(place.objects().join("a.json")).unwrap();
    std::fs::create_dir(place.objects().join("a.json")).unwrap();
    assert_eq!(post(address, "/api/marks", r#"{"view":"a","marks":[{"kind":"object","at":[0.1,0.1]}]}"#).0, 503);
    assert!(std::fs::read(place.objects().join("a.png")).unwrap() == mask);
    std::fs::remove_dir(place.objects().join("a.json")).unwrap();
    std::fs::write(place.objects().join("a.json"), &marks).unwrap();
    // Nothing is waited for, and what was marked counts.
    let after = state(address);
    assert_eq!(
        (&after["views"][0]["busy"], &after["views"][0]["objects"][0]["marks"]),
        (&json!(false), &before["views"][0]["objects"][0]["marks"])
    );
    assert_eq!(after["views"][0]["objects"][0]["share"], before["views"][0]["objects"][0]["share"]);
    let gone = "c & <d>";
    std::fs::remove_file(&place.photographs[gone]).unwrap();
    let (status, why) = post(address, "/api/marks", &CLICK.replace("\"a\"", &format!("\"{gone}\"")));
    assert!(status == 503 && why.contains(gone), "{status} {why}");
    assert_eq!(state(address)["views"][2]["busy"], false);
    assert_eq!(post(address, "/api/marks", further).0, 200);
}

/// What is on disk is begun with when the folder is opened again, not made anew of all marks.
#[test]
fn a_cut_after_reopening_begins_with_the_mask_on_disk() {
    let place = Place::new();
    // As no click would have it.
    let own = GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| Luma([if x < 40 && y < 30 { 255 } else { 0 }]));
    let click = Mark::Object { at: [0.1, 0.1], scale: 0 };
    objects::write(&place.objects(), "a", SIZE, std::slice::from_ref(&click), Some(&own)).unwrap();
    let session = place.open();
    let brush = Mark::Brush { object: true, radius: 0.02, points: vec![[0.9, 0.9]] };
    session.mark(1, 0, vec![click.clone(), brush.clone()]).unwrap();
    let mask = scene::mask(&place.objects().join("a.png"), 1).unwrap();
    let differs = |(x, y, v): (u32, u32, &Luma<u8>)| (x < 130 && v != own.get_pixel(x, y)).then_some([x, y]);
    assert_eq!(mask.enumerate_pixels().find_map(differs), None);
    assert_eq!(mask.get_pixel(144, 108).0, [255]);
    // One that is known to be made of other marks is not.
    session.mark(1, 0, vec![brush]).unwrap();
    assert_eq!(scene::mask(&place.objects().join("a.png"), 1).unwrap().get_pixel(10, 10).0, [0]);
}

/// The depth of a view arrives while the mask of a click is made without it: the mask is made once more.
#[test]
fn depth_that_comes_during_a_click_counts() {
    let place = Place::new();
    let session = place.open();
    // Whoever wants the photograph waits, and has looked for the depth before.
    let held = session.pictures.lock().unwrap();
    std::thread::scope(|scope| {
        let click = scope.spawn(|| session.mark(1, 0, vec![Mark::Object { at: [0.44, 0.5], scale: 0 }]));
        while session.cutting.try_lock().is_ok() {
            std::thread::yield_now();
        }
        std::thread::sleep(Duration::from_millis(50));
        let camera = Camera {
            rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
            translation: [0.0; 3],
            focal: [150.0; 2],
            principal: [80.0, 60.0],
            distortion: [0.0; 4],
            size: SIZE,
        };
        let near = |i: u32| if is_object(i % SIZE[0], i / SIZE[0]) { 1.5 } else { 2.0 };
        session
            .knows(0, [camera; 2].map(|camera| DepthMap { camera, depth: (0..SIZE[0] * SIZE[1]).map(near).collect() }));
        session.again();
        drop(held);
        click.join().unwrap().unwrap();
    });
    let view = session.lock().objects[0].views[0].clone();
    let (_, with_depth, mask) = view.made.last().unwrap();
    assert_eq!((*with_depth, view.version, view.drawn), (Some(true), 3, 3));
    assert!(Arc::ptr_eq(mask, view.mask.as_ref().unwrap()));
    session.again();
    assert_eq!(session.lock().objects[0].views[0].drawn, 4);
}

/// Pixels are counted when a mask is made: a hundred views of large masks cost a poll nothing.
#[test]
fn what_is_said_of_views_is_made_once() {
    let place = Place::new();
    let session = place.open();
    session.mark(1, 0, vec![Mark::Object { at: [0.44, 0.5], scale: 0 }]).unwrap();
    let said = || session.status();
    let first = said();
    let kept = session.lock().said.clone().unwrap();
    assert!(first == said() && Arc::ptr_eq(&kept, session.lock().said.as_ref().unwrap()));
    let share = serde_json::from_str::<Value>(&first).unwrap()["views"][0]["objects"][0]["share"].as_f64().unwrap();
    let truth = truth().as_raw().iter().filter(|v| **v != 0).count() as f64 / f64::from(SIZE[0] * SIZE[1]);
    assert!((share / truth - 1.0).abs() < 0.1, "{share} {truth}");
    session.mark(1, 0, vec![]).unwrap();
    assert!(serde_json::from_str::<Value>(&said()).unwrap()["views"][0]["objects"][0]["share"].is_null());
}

#[test]
fn nonsense_is_refused_in_a_sentence() {
    let place = Place::new();
    let session = place.open();
    let address = serve(&session);
    let send = |path: &str, body: &str| post(address, path, body);
    let (status, said) = send("/api/marks", &CLICK.replace("\"a\"", "\"../a\""));
    assert_eq!((status, said.as_str()), (404, "no photograph is called \"../a\"\n"));
    for body in [
        "",
        "{",
        "[]",
        r#"{"view":"a"}"#,
        r#"{"view":"a","marks":[{"kind":"object","at":[0.5]}]}"#,
        r#"{"view":"a","marks":[{"kind":"object","at":[0.5,2]}]}"#,
        r#"{"view":"a","marks":[{"kind":"object","at":[0.5,-1e-9]}]}"#,
        r#"{"view":"a","marks":[{"kind":"box","bounds":[0.5,0.5,0.5,0.9]}]}"#,
        r#"{"view":"a","marks":[{"kind":"thing","at":[0.5,0.5]}]}"#,
        r#"{"view":"a","marks":[],"path":"/etc"}"#,
        &format!(r#"{{"view":"a","marks":[{}]}}"#, [r#"{"kind":"object","at":[0.5,0.5]}"#; 401].join(",")),
    ] {
        let (status, said) = send("/api/marks", body);
        assert!(status == 400 && said.lines().count() == 1, "{body}: {status} {said}");
    }
    let (status, _) = send("/api/marks", &format!("{}{}", " ".repeat(1 << 19), CLICK));
    assert_eq!(status, 413);
    assert_eq!(send("/api/other", "{}").0, 404);
    assert_eq!(send("/api/repaint", r#"{"undo":{}}"#), (409, "remove the object first\n".into()));
    let (status, said) = send("/api/remove", "{}");
    assert_eq!((status, said.as_str()), (409, "nothing is marked yet; draw around what is to be removed\n"));
    assert_eq!(state(address)["revision"], 1);
}

/// One click, then none: files come and go, and another session has what this one had.
#[test]
fn what_is_marked_is_kept_and_found_again() {
    let place = Place::new();
    let session = place.open();
    let address = serve(&session);
    let (status, said) = post(address, "/api/marks", CLICK);
    let said: Value = serde_json::from_str(&said).unwrap();
    assert_eq!((status, &said["views"][0]["objects"][0]["origin"]), (200, &json!("marks")), "{said}");
    let [png, kept] = ["a.png", "a.json"].map(|name| place.objects().join(name));
    let mask = scene::mask(&png, 1).unwrap();
    assert!(iou(&mask, &truth()) > 0.9, "{}", iou(&mask, &truth()));
    assert_eq!(get(address, "/overlay.png?view=a").0, 200);
    assert_eq!(objects::all(&place.objects(), place.photographs.iter()).unwrap(), [("a".to_owned(), png.clone())]);

    let again = place.open();
    let view = again.lock().objects[0].views[0].clone();
    assert_eq!((view.marks.len(), view.origin), (1, Origin::Marks));
    assert!(view.mask.is_some_and(|kept| *kept == mask));
    // Changed by hand: the marks are of another mask.
    GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| Luma([if x < 40 && y < 30 { 255 } else { 0 }])).save(&png).unwrap();
    let view = place.open().lock().objects[0].views[0].clone();
    assert_eq!((view.marks.len(), view.origin), (0, Origin::File));
    GrayImage::new(3, 3).save(&png).unwrap();
    assert!(Session::open("place", &place.photographs, &place.objects(), &BTreeMap::new()).is_err());

    let (status, _) = post(address, "/api/marks", r#"{"view":"a","marks":[]}"#);
    assert_eq!(status, 200);
    assert!(!png.exists() && !kept.exists());
    assert_eq!(get(address, "/overlay.png?view=a").0, 404);
}

/// Two pages at once: whatever they do, the files are of one of them, and the mask is that of its marks.
#[test]
fn the_last_of_two_pages_wins() {
    let place = Place::new();
    let session = place.open();
    let address = serve(&session);
    std::thread::scope(|scope| {
        for page in 0..2 {
            scope.spawn(move || {
                for turn in 0..6 {
                    let x = 0.36 + 0.01 * f64::from(turn + 6 * page);
                    let body = CLICK.replace("0.44", &x.to_string());
                    assert_eq!(post(address, "/api/marks", &body).0, 200);
                }
            });
        }
    });
    let view = session.lock().objects[0].views[0].clone();
    assert_eq!((view.version, view.drawn), (13, 13));
    let (marks, mask) = objects::read(&place.objects(), "a", SIZE).unwrap().unwrap();
    assert_eq!(marks, view.marks);
    assert!(view.mask.is_some_and(|own| *own == mask));
    let revision = session.lock().revision;
    assert!((2..=13).contains(&revision), "{revision}");
}

#[test]
fn work_is_asked_for_once_and_can_be_stopped() {
    let place = Place::new();
    let session = place.open();
    let address = serve(&session);
    let send = |path: &str, body: &str| post(address, path, body).0;
    assert!(matches!(session.wish(Duration::ZERO), Wish::Nothing), "nothing is carried without a fit");
    assert_eq!(send("/api/marks", CLICK), 200);
    session.ready();
    let Wish::Carry(2, given) = session.wish(Duration::ZERO) else { panic!("masks are carried") };
    assert_eq!(given[&1].iter().map(|(view, ..)| *view).collect::<Vec<_>>(), [0]);
    let carried = |part: f32| Carried { object: vec![part; 12], evidence: vec![0.2; 12] };
    assert!(session.carry(2, 1, 1, carried(0.9), [4, 3]));
    session.carried(2);
    assert!(matches!(session.wish(Duration::ZERO), Wish::Nothing));
    let said = state(address);
    assert_eq!((&said["next"], &said["views"][1]["doubt"]), (&json!("b"), &json!(1.0)));
    // Masks of before are not shown.
    assert_eq!(send("/api/marks", &CLICK.replace("0.44", "0.45")), 200);
    assert!(!session.carry(2, 1, 1, carried(0.1), [4, 3]));

    assert_eq!(send("/api/remove", "{}"), 200);
    assert_eq!(send("/api/remove", "{}"), 409);
    assert_eq!(send("/api/marks", CLICK), 409);
    assert_eq!(state(address)["phase"], "working");
    // Before it has begun, stopping is all there is to it.
    assert_eq!(send("/api/stop", "{}"), 200);
    assert_eq!(state(address)["phase"], "choosing");
    assert_eq!(send("/api/remove", r#"{"despite":true}"#), 200);
    assert!(matches!(session.wish(Duration::ZERO), Wish::Remove(true)));
    session.found(vec![]);
    assert_eq!(state(address)["phase"], "working");
    assert_eq!(send("/api/stop", "{}"), 200);
    assert!(session.stopping().load(Ordering::Relaxed));
    session.stopped();
    session.fail("there is no device");
    assert_eq!(state(address)["error"], "there is no device");
    let file = place.folder.path().join("scene.ply");
    std::fs::write(&file, b"ply").unwrap();
    session.done(Results::new(vec![], vec![("scene.ply".into(), file)], BTreeMap::new()));
    assert_eq!(get(address, "/download/scene.ply"), (200, b"ply".to_vec()));
    assert_eq!(get(address, "/download/%2e%2e/a.png").0, 404);
}

/// What is there of before and after is told; a view is drawn once it is asked for, and once.
#[test]
fn views_without_the_object_are_drawn_when_they_are_looked_at() {
    let place = Place::new();
    let session = place.open();
    let address = serve(&session);
    let before = || {
        let all = place.photographs.iter().take(2).map(|(name, path)| (session.number(name).unwrap(), path.clone()));
        Results::new(vec![], vec![], all.collect())
    };
    assert_eq!((get(address, "/before.jpg?view=a").0, get(address, "/after.jpg?view=a").0), (404, 404));
    session.done(before());
    assert_eq!(state(address)["compare"], json!(["a", "b"]));
    let (status, jpeg) = get(address, "/before.jpg?view=b");
    let shown = image::load_from_memory(&jpeg).unwrap().into_rgb8();
    assert!(status == 200 && shown.dimensions() == photograph().dimensions());
    assert_eq!(get(address, "/after.jpg?view=c%20%26%20%3Cd%3E").0, 404, "it has no camera");
    assert!(matches!(session.wish(Duration::ZERO), Wish::Nothing));
    for view in ["a", "b", "a"] {
        assert_eq!(get(address, &format!("/after.jpg?view={view}")).0, 503);
    }
    assert!(matches!(session.wish(Duration::ZERO), Wish::Draw(1)));
    let jpeg = crate::scene::jpeg(&photograph(), 90).unwrap();
    assert_eq!(state(address)["left"], json!(null));
    session.drew(1, Some(After { jpeg: jpeg.clone(), residue: Some(0.25) }));
    assert_eq!(state(address)["left"], json!({ "most": 0.25, "view": "b", "mean": 0.25, "of": 1 }));
    assert_eq!(get(address, "/after.jpg?view=b"), (200, jpeg.clone()));
    let (status, small) = get(address, "/after.jpg?view=b&small=1");
    let [small, thumbnail] =
        [small, get(address, "/thumb.jpg?view=b").1].map(|of| image::load_from_memory(&of).unwrap());
    assert_eq!((status, small.width(), small.height()), (200, thumbnail.width(), thumbnail.height()));
    assert!(matches!(session.wish(Duration::ZERO), Wish::Draw(0)));
    // It failed, and is not asked for again.
    session.drew(0, None);
    assert_eq!(get(address, "/after.jpg?view=a").0, 404);
    assert!(matches!(session.wish(Duration::ZERO), Wish::Nothing));
    assert_eq!(state(address)["compare"], json!(["b"]));
    // Those of another removal are others.
    session.done(before());
    assert_eq!((get(address, "/after.jpg?view=b").0, &state(address)["removals"]), (503, &json!(2)));
    for (number, residue) in [(0, Some(0.5)), (2, Some(0.25))] {
        session.drew(number, Some(After { jpeg: jpeg.clone(), residue }));
    }
    assert_eq!(state(address)["left"], json!({ "most": 0.5, "view": "a", "mean": 0.375, "of": 2 }));
    assert_eq!(post(address, "/api/marks", CLICK).0, 200);
    assert_eq!(post(address, "/api/remove", "{}").0, 200);
    assert!(matches!(session.wish(Duration::ZERO), Wish::Remove(false)));
    assert_eq!(get(address, "/after.jpg?view=b").0, 404);
    assert!(matches!(session.wish(Duration::ZERO), Wish::Nothing));
}

/// Once the object is gone a part is repainted at a time, and the page is told what came of it until the scene is trained again.
#[test]
fn a_part_is_repainted_at_a_time() {
    let place = Place::new();
    let session = place.open();
    let address = serve(&session);
    session.done(Results::default());
    let stroke = r#"{"kind":"brush","object":true,"radius":0.1,"points":[[0.5,0.5]]}"#;
    let paint = |strokes: &str, offset: &str| {
        let body = format!(r#"{{"paint":{{"view":"a","strokes":[{strokes}],"offset":{offset}}}}}"#);
        post(address, "/api/repaint", &body).0
    };
    let erase = stroke.replace("true", "false");
    let bad = [("", "null"), (erase.as_str(), "null"), (stroke, "[0.1,1.5]")];
    assert!(bad.iter().all(|(strokes, offset)| paint(strokes, offset) == 400));
    assert_eq!((paint(stroke, "[-0.5,0]"), paint(stroke, "null")), (200, 409), "one at a time");
    let Wish::Repaint(Repainting::Paint(0, brush, offset)) = session.wish(Duration::ZERO) else { panic!("no wish") };
    let ([w, h], count) = (photograph().dimensions().into(), brush.as_raw().iter().filter(|v| **v != 0).count());
    assert_eq!((brush.dimensions(), offset), ((w, h), Some([-(w as i32) / 2, 0])));
    let disc = std::f64::consts::PI * (0.1 * f64::from(w.max(h))).powi(2);
    assert!((count as f64 / disc - 1.0).abs() < 0.1, "{count} of {disc}");
    session.repainted(Some("beside the hole".into()));
    let told = || state(address)["painting"].clone();
    assert_eq!(told(), json!({ "busy": false, "count": 0, "untrained": false, "refused": "beside the hole" }));
    assert_eq!(post(address, "/api/repaint", r#"{"undo":{}}"#).0, 200);
    assert!(matches!(session.wish(Duration::ZERO), Wish::Repaint(Repainting::Undo)));
    session.repainted(None);
    assert_eq!(told(), json!({ "busy": false, "count": 1, "untrained": true, "refused": null }));
    session.done(Results::default());
    assert_eq!(told()["untrained"], json!(false));
}

/// The bytes of all files in a folder and the folders below it, by their path.
fn all_files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    for path in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
        if path.is_dir() {
            all.extend(all_files(&path));
        } else {
            all.insert(path.clone(), std::fs::read(path).unwrap());
        }
    }
    all
}

/// Who removes one object has its files where they were and no others, after another one has come and gone as well.
#[test]
fn an_object_that_is_alone_has_no_list() {
    let place = Place::new();
    let own = || -> Vec<PathBuf> {
        let photographs = place.photographs.values();
        all_files(place.folder.path()).into_keys().filter(|path| photographs.clone().all(|own| own != path)).collect()
    };
    let address = serve(&place.open());
    assert_eq!(post(address, "/api/marks", CLICK).0, 200);
    let alone = all_files(place.folder.path());
    assert_eq!(own(), ["a.json", "a.png"].map(|name| place.objects().join(name)));
    let marks = String::from_utf8(alone[&place.objects().join("a.json")].clone()).unwrap();
    let hash = blake3::hash(&alone[&place.objects().join("a.png")]).to_hex();
    let written = "{\n  \"marks\": [\n    {\n      \"kind\": \"object\",\n      \"at\": [\n        0.44,\n        0.5\n      ]\n    }\n  ],\n  \"mask\": \"";
    assert_eq!(marks, format!("{written}{hash}\"\n}}"));
    let change = |what: &str| post(address, "/api/objects", what);
    assert_eq!(change(r#"{"add":{}}"#).0, 200);
    assert_eq!(post(address, "/api/marks", &CLICK.replacen('{', "{\"object\":2,", 1)).0, 200);
    assert_eq!(own().len(), 5);
    assert_eq!(change(r#"{"delete":{"object":2}}"#).0, 200);
    assert!(all_files(place.folder.path()) == alone);
    let (status, why) = change(r#"{"delete":{"object":1}}"#);
    assert_eq!((status, why.as_str()), (409, "the only object cannot be deleted; clear its marks\n"));
}

/// Objects are marked, named, left in the scene, deleted and brought back, and another session finds what this one had.
#[test]
fn objects_are_kept_in_a_list() {
    let place = Place::new();
    let session = place.open();
    let address = serve(&session);
    let change = |what: Value| post(address, "/api/objects", &what.to_string());
    let mark = |object: usize, view: &str, at: [f64; 2]| {
        let body = json!({ "object": object, "view": view, "marks": [{ "kind": "object", "at": at }] });
        post(address, "/api/marks", &body.to_string())
    };
    assert_eq!(change(json!({ "add": {} })).0, 200);
    assert_eq!(change(json!({ "rename": { "object": 2, "name": " the ball " } })).0, 200);
    assert_eq!((mark(1, "a", [0.44, 0.5]).0, mark(2, "b", [0.05, 0.05]).0), (200, 200));
    let said = state(address);
    let told = |said: &Value| -> Vec<(String, bool, u64)> {
        let of = |o: &Value| (o["name"].as_str().unwrap().into(), o["remove"] == true, o["marked"].as_u64().unwrap());
        said["objects"].as_array().unwrap().iter().map(of).collect()
    };
    let both = [("Object 1".to_owned(), true, 1), ("the ball".to_owned(), true, 1)];
    assert_eq!((told(&said), &said["marked"]), (both.to_vec(), &json!(2)));
    let origins = |view: usize| [0, 1].map(|object| said["views"][view]["objects"][object]["origin"].clone());
    assert_eq!([origins(0), origins(1)], [["marks", "none"], ["none", "marks"]]);
    // A picture has all objects, each in its colour.
    let color = |view: &str, at: [u32; 2]| {
        let (status, png) = get(address, &format!("/overlay.png?view={view}"));
        assert_eq!(status, 200);
        image::load_from_memory(&png).unwrap().into_rgba8().get_pixel(at[0], at[1]).0
    };
    let [first, second] = [color("a", [70, 60]), color("b", [8, 6])];
    assert!(first[..3] != second[..3] && first[3] > 0 && second[3] > 0, "{first:?} {second:?}");
    session.ready();
    let Wish::Carry(_, given) = session.wish(Duration::ZERO) else { panic!("masks are carried") };
    let views = |object: usize| given[&object].iter().map(|(view, ..)| *view).collect::<Vec<_>>();
    assert_eq!((views(1), views(2)), (vec![0], vec![1]));
    // What is not ticked stays in the scene, with its marks.
    let wanted = || objects::wanted(&place.objects(), place.photographs.iter()).unwrap();
    let names = || wanted().into_iter().map(|object| (object.name, object.evidence[0].0.clone())).collect::<Vec<_>>();
    let [one, ball] = [("Object 1".to_owned(), "a.png".to_owned()), ("the ball".to_owned(), "b.png".to_owned())];
    assert_eq!(names(), [one.clone(), ball.clone()]);
    assert_eq!(change(json!({ "tick": { "object": 1, "remove": false } })).0, 200);
    assert_eq!((names(), wanted()[0].delivered), (vec![ball.clone()], false));
    assert_eq!(told(&state(address))[0], ("Object 1".to_owned(), false, 1));
    assert_eq!(post(address, "/api/marks", r#"{"object":2,"view":"b","marks":[]}"#).0, 200);
    let (status, why) = post(address, "/api/remove", "{}");
    assert_eq!((status, why.as_str()), (409, "no object that is ticked is marked yet; tick one, or draw around it\n"));
    // The only one that is left goes, whatever was ticked.
    let before = all_files(place.folder.path());
    assert_eq!(change(json!({ "delete": { "object": 2 } })).0, 200);
    assert_eq!((names(), &state(address)["deleted"]), (vec![one], &json!("the ball")));
    assert_eq!(mark(2, "b", [0.05, 0.05]).0, 404);
    assert_eq!(change(json!({ "restore": {} })).0, 200);
    assert!(all_files(place.folder.path()) == before);
    assert_eq!((change(json!({ "restore": {} })).0, mark(2, "b", [0.05, 0.05]).0), (409, 200));

    let again = place.open();
    let entries = |session: &Session| session.lock().objects.iter().map(|own| own.entry.clone()).collect::<Vec<_>>();
    assert_eq!(entries(&again), entries(&session));
    assert_eq!(again.lock().objects[1].views[1].marks.len(), 1);
    for nonsense in ["", "{", "{}", r#"{"add":{"x":1}}"#, r#"{"rename":{"object":1,"name":" "}}"#, r#"{"other":{}}"#] {
        let (status, said) = post(address, "/api/objects", nonsense);
        assert!(status == 400 && said.lines().count() == 1, "{nonsense}: {status} {said}");
    }
    assert_eq!(change(json!({ "tick": { "object": 7, "remove": true } })).0, 404);
    // While it is being removed the list stays; one that was changed by hand and is none is refused.
    session.remove(false).unwrap();
    assert_eq!(change(json!({ "add": {} })).0, 409);
    let list = place.objects().with_extension("json");
    for text in ["[]", "{", r#"[{"number":0,"name":"a","remove":true}]"#, r#"[{"number":2,"name":"","remove":true}]"#] {
        std::fs::write(&list, text).unwrap();
        let why =
            Session::open("place", &place.photographs, &place.objects(), &BTreeMap::new()).err().unwrap().to_string();
        assert!(why.contains("objects.json: it is no list of objects"), "{why}");
    }
}
