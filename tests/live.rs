//! Visitors of a running training, at the level of the process: whatever they do, it comes to the same bytes.

use crate::common;
use std::fs;
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use assert_cmd::cargo::cargo_bin;

/// How long a hostile client waits for anything.
const IMPATIENT: Duration = Duration::from_millis(200);

fn program(folder: &Path, arguments: &str) -> Command {
    let mut command = Command::new(cargo_bin!("gscream-vk"));
    command.args(arguments.split_whitespace()).current_dir(folder);
    command.env("XDG_CACHE_HOME", env!("CARGO_TARGET_TMPDIR")).env_remove("RUST_LOG");
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
    command
}

/// Sends a request and returns what comes back soon.
fn ask(address: SocketAddr, request: &[u8]) -> Vec<u8> {
    let Ok(mut stream) = TcpStream::connect_timeout(&address, IMPATIENT) else { return vec![] };
    let (mut answer, mut piece) = (vec![], [0; 4096]);
    if stream.set_read_timeout(Some(IMPATIENT)).is_err() || stream.write_all(request).is_err() {
        return vec![];
    }
    while let Ok(read @ 1..) = stream.read(&mut piece) {
        answer.extend_from_slice(&piece[..read]);
    }
    answer
}

/// Asks without pause until told to stop; counts the answers to requests that make sense.
fn hostile(address: SocketAddr, secret: &str, number: usize, stop: &AtomicBool, answers: &AtomicU32) {
    let get = |path: &str, host: &str| format!("GET /{secret}{path} HTTP/1.1\r\nHost: {host}\r\n\r\n").into_bytes();
    let picture = "/picture.jpg?c=0,0,0&r=1,0,0,0,1,0,0,0,1&f=1,1&s=64,48";
    let requests = [
        get("/state.json", "localhost"),
        get("/scene.json", "localhost"),
        get(picture, "localhost"),
        get("/state.json", "evil.example"),
        get("/picture.jpg?c=nan,inf,0", "localhost"),
        vec![0xff; 40_000],
        b"GET / HT".to_vec(),
    ];
    let mut held = vec![];
    for turn in number.. {
        if stop.load(Ordering::Relaxed) {
            return;
        }
        let answer = ask(address, &requests[turn % requests.len()]);
        if answer.starts_with(b"HTTP/1.1 200 ") {
            answers.fetch_add(1, Ordering::Relaxed);
        }
        let text = String::from_utf8_lossy(&answer);
        let leaked = turn % requests.len() == 3 && text.contains("iterations");
        assert!(!leaked, "a page of another name reads the training: {text}");
        // One that never says what it wants, with every turn.
        held.extend(TcpStream::connect_timeout(&address, IMPATIENT));
        held.truncate(40);
    }
}

#[test]
fn hostile_clients_change_nothing_of_a_training() {
    let folder = common::folder();
    let folder = folder.path();
    fs::write(folder.join("settings.toml"), common::settings(150).to_toml()).expect("a writable folder");
    let train = "train scene --config settings.toml --out";
    let began = Instant::now();
    let alone = program(folder, &format!("{train} alone")).output().expect("the program starts");
    let alone_took = began.elapsed();
    assert!(alone.status.success(), "{}", String::from_utf8_lossy(&alone.stderr));

    let began = Instant::now();
    let mut child = program(folder, &format!("{train} visited --view=127.0.0.1:0")).spawn().expect("it starts");
    let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
    let address = lines.find_map(|line| {
        line.expect("text").strip_prefix("view: http://").map(|rest| rest.trim_end_matches('/').to_owned())
    });
    let address = address.expect("it says where");
    let (address, secret) = address.split_once('/').expect("an address and the secret");
    let address: SocketAddr = address.parse().expect("an address");
    // Whoever has only the port learns nothing.
    for path in ["/", "/state.json", "/scene.json"] {
        let told = ask(address, format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes());
        assert!(told.is_empty() || told.starts_with(b"HTTP/1.1 403 "), "{}", String::from_utf8_lossy(&told));
    }
    let (stop, answers) = (AtomicBool::new(false), AtomicU32::new(0));
    std::thread::scope(|scope| {
        for number in 0..8 {
            let (stop, answers) = (&stop, &answers);
            scope.spawn(move || hostile(address, secret, number, stop, answers));
        }
        // Notes are read to the end, which is the program's.
        let rest: Vec<String> = lines.map(|line| line.expect("text")).collect();
        stop.store(true, Ordering::Relaxed);
        assert!(child.wait().expect("a child").success(), "{rest:?}");
    });
    println!(
        "alone {alone_took:.2?}, with eight hostile clients {:.2?}; {} answers",
        began.elapsed(),
        answers.load(Ordering::Relaxed)
    );
    assert!(answers.load(Ordering::Relaxed) > 0, "nobody was served");
    for file in ["model/point_cloud.ply", "model/weights.safetensors", "metrics.json"] {
        let of = |run: &str| fs::read(folder.join(run).join(file)).expect(file);
        assert!(of("visited") == of("alone"), "{file} differs");
    }
}
