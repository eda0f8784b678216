use std::sync::Condvar;

use super::*;

/// Short times, and no pause between connections.
const QUICK: Limits = Limits {
    clients: 64,
    request: Duration::from_millis(300),
    answer: Duration::from_millis(300),
    rate: 1e9,
    pace: Duration::ZERO,
};
/// As nobody waits in a test: the machine may be busy.
const PATIENT: Limits = Limits { request: Duration::from_secs(60), answer: Duration::from_secs(60), ..QUICK };
/// More than the system keeps of an answer that nobody reads.
const BIG: usize = 64 << 20;

fn files() -> Vec<Resource> {
    let file = |path, gzip, bytes: Vec<u8>| Resource { path, kind: "text/plain", gzip, bytes };
    vec![
        file("/", false, b"page".to_vec()),
        file("/big", true, vec![b'Q'; 3_000_000]),
        file("/huge", false, vec![0; BIG]),
    ]
}

/// The secret of the tests' servers.
fn secret() -> Secret {
    Secret::known("s")
}

fn start_with<S: Site>(site: S, limits: Limits) -> (SocketAddr, Arc<S>) {
    let listener = bind(([127, 0, 0, 1], 0).into()).expect("a free port");
    let address = listener.local_addr().expect("it is bound");
    let site = Arc::new(site);
    let served = site.clone();
    std::thread::spawn(move || serve_within(&listener, &served, &secret(), limits));
    (address, site)
}

fn start(limits: Limits) -> (SocketAddr, Arc<Vec<Resource>>) {
    start_with(files(), limits)
}

fn connect(address: SocketAddr) -> TcpStream {
    let stream = TcpStream::connect(address).expect("the server listens");
    stream.set_read_timeout(Some(Duration::from_secs(60))).expect("a positive time");
    stream
}

/// What comes back, whole.
fn ask(address: SocketAddr, request: &[u8]) -> Vec<u8> {
    let mut stream = connect(address);
    stream.write_all(request).expect("the server reads");
    let mut answer = vec![];
    stream.read_to_end(&mut answer).expect("the server answers");
    answer
}

fn get(address: SocketAddr, path: &str) -> String {
    let answer = ask(address, format!("GET /s{path} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes());
    String::from_utf8(answer).expect("text")
}

#[track_caller]
fn assert_status(answer: &[u8], status: u32) {
    let answer = String::from_utf8_lossy(answer);
    assert!(answer.starts_with(&format!("HTTP/1.1 {status} ")), "{status}: {answer}");
}

/// Connections that still have a thread.
fn threads(site: &Arc<impl Site>) -> usize {
    // The listener's and the test's own.
    Arc::strong_count(site) - 2
}

fn wait_until(what: &str, holds: impl Fn() -> bool) {
    let began = Instant::now();
    while !holds() {
        assert!(began.elapsed() < Duration::from_secs(60), "{what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn files_are_served_and_nothing_else() {
    let (address, _) = start(PATIENT);
    let page = get(address, "/?noui");
    assert!(page.starts_with("HTTP/1.1 200 OK\r\n") && page.ends_with("\r\n\r\npage"), "{page}");
    let head = ask(address, b"HEAD /s/big HTTP/1.1\r\nHost: localhost\r\n\r\n");
    let head = String::from_utf8(head).expect("text");
    assert!(head.contains("Content-Encoding: gzip\r\n") && head.ends_with("\r\n\r\n"), "{head}");
    assert!(head.contains("Content-Length: 3000000\r\n"), "{head}");
    assert_eq!(get(address, "/big").matches('Q').count(), 3_000_000);
    assert_status(&ask(address, b"GET /s/../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n"), 404);
    assert_status(&ask(address, b"POST /s/ HTTP/1.1\r\nHost: localhost\r\nContent-Length: 3\r\n\r\nabc"), 405);
}

/// Rebinding: a page of another site whose name was pointed at this machine asks under that name.
#[test]
fn requests_for_other_hosts_are_refused() {
    let (address, _) = start(PATIENT);
    let port = address.port();
    let of = |host: &str| ask(address, format!("GET /s/ HTTP/1.1\r\nHost: {host}\r\n\r\n").as_bytes());
    for host in ["localhost", "LocalHost:1", "127.0.0.1", "[::1]", "[::1]:80", "[::ffff:127.0.0.1]"] {
        assert_status(&of(host), 200);
    }
    assert_status(&of(&format!("localhost:{port}")), 200);
    assert_status(&of(&address.to_string()), 200);
    for host in [
        "evil.example",
        "evil.example:8642",
        "localhost.evil.example",
        "127.0.0.1.evil.example",
        "evil.example@localhost",
        "localhost:",
        "localhost:99999",
        "localhost:80:80",
        "127.0.0.1 evil.example",
        "192.168.0.1",
        "0.0.0.0",
        "[::2]",
        "[::1",
        "::1",
        "[127.0.0.1]",
    ] {
        let answer = of(host);
        assert_status(&answer, 421);
        assert!(!String::from_utf8_lossy(&answer).contains("page"), "{host}");
    }
    assert_status(&of(""), 421);
    assert_status(&ask(address, b"GET /s/ HTTP/1.1\r\n\r\n"), 400);
    assert_status(&ask(address, b"GET /s/ HTTP/1.1\r\nHost: localhost\r\nhost: evil.example\r\n\r\n"), 400);
    assert_status(&ask(address, b"GET http://evil.example/ HTTP/1.1\r\nHost: localhost\r\n\r\n"), 400);
    // Bound to another address than the loopback's, that one is meant, too.
    let [ours, other]: [IpAddr; 2] = [[192, 168, 0, 7].into(), [192, 168, 0, 8].into()];
    assert!(names("192.168.0.7:8642", ours) && !names("192.168.0.7:8642", other));
}

/// Another user of the machine, or another site's page, has the port and not the secret: it learns nothing.
#[test]
fn whoever_has_only_the_port_learns_nothing() {
    let (address, _) = start(PATIENT);
    for path in [
        "/",
        "/s",
        "/big",
        "/none",
        "/S/",
        "/ss/",
        "//",
        "/?s/",
        "/%73/",
        "/../s/",
        "/state.json",
        "/api/state",
        "/s%2f",
    ] {
        for method in ["GET", "HEAD", "POST", "PUT"] {
            let answer = ask(address, format!("{method} {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes());
            assert_status(&answer, 403);
            let answer = String::from_utf8(answer).expect("text");
            assert!(!answer.contains("page") && !answer.contains("/s/"), "{answer}");
        }
    }
    assert_status(get(address, "/").as_bytes(), 200);
    let [one, other] = [Secret::random(), Secret::random()];
    assert!(one.0.len() == 32 && one.0 != other.0, "128 bits, anew for each server");
}

/// A picture or a form in another site's page, were it to know the secret.
#[test]
fn what_other_sites_pages_ask_for_is_refused() {
    let (address, _) = start(PATIENT);
    let of = |site: &str| {
        ask(address, format!("GET /s/ HTTP/1.1\r\nHost: localhost\r\nSec-Fetch-Site: {site}\r\n\r\n").as_bytes())
    };
    assert_status(&of("cross-site"), 403);
    for site in ["none", "same-origin", "same-site"] {
        assert_status(&of(site), 200);
    }
}

/// Files of the site that are read while they are sent.
struct Folder(std::path::PathBuf);

impl Site for Folder {
    fn get(&self, path: &str, _: &str) -> Result<Answer<'_>, Refusal> {
        let file = File::open(self.0.join(&path[1..])).map_err(|_| Refusal::NotFound)?;
        // One that shrinks meanwhile has fewer bytes than were announced.
        let length = file.metadata().map_err(|_| Refusal::NotFound)?.len() + u64::from(path == "/short");
        Ok(Answer { kind: "text/plain", gzip: false, bytes: Body::File(file, length) })
    }
}

#[test]
fn files_are_read_while_they_are_sent() {
    let folder = tempfile::tempdir().expect("a folder");
    let bytes: Vec<u8> = (0..3 * PIECE + 17).map(|i| (i % 251) as u8).collect();
    for name in ["whole", "short"] {
        std::fs::write(folder.path().join(name), &bytes).expect("writable");
    }
    let (address, site) = start_with(Folder(folder.path().to_owned()), PATIENT);
    let of = |request: &str| ask(address, format!("{request} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes());
    let answer = of("GET /s/whole");
    assert_status(&answer, 200);
    assert!(answer.ends_with(&bytes) && answer.len() < bytes.len() + 1000);
    let head = String::from_utf8(of("HEAD /s/whole")).expect("text");
    assert!(head.contains(&format!("Content-Length: {}\r\n", bytes.len())) && head.ends_with("\r\n\r\n"), "{head}");
    assert!(of("GET /s/short").ends_with(&bytes), "the connection ends where the file does");
    wait_until("all are gone", || threads(&site) == 0);
}

#[test]
fn every_answer_keeps_other_sites_out() {
    let (address, _) = start(PATIENT);
    for (request, status) in [
        ("GET /s/ HTTP/1.1\r\nHost: localhost", 200),
        ("GET /s/none HTTP/1.1\r\nHost: localhost", 404),
        ("GET /none HTTP/1.1\r\nHost: localhost", 403),
        ("GET /s/ HTTP/1.1\r\nHost: evil.example", 421),
        ("nonsense", 400),
    ] {
        let answer = ask(address, format!("{request}\r\n\r\n").as_bytes());
        assert_status(&answer, status);
        let answer = String::from_utf8(answer).expect("text");
        for field in [
            "Content-Security-Policy: default-src 'none'; ",
            "Cross-Origin-Resource-Policy: same-origin\r\n",
            "Referrer-Policy: no-referrer\r\n",
            "X-Content-Type-Options: nosniff\r\n",
            "Cache-Control: no-store\r\n",
        ] {
            assert!(answer.contains(field), "no {field:?} in {answer}");
        }
        assert!(!answer.to_lowercase().contains("access-control-allow"), "{answer}");
    }
    assert!(!POLICY.contains("http"), "nothing from elsewhere: {POLICY}");
}

#[test]
fn malformed_requests_are_told_so() {
    let (address, _) = start(PATIENT);
    let host = "Host: localhost\r\n";
    let long = |bytes: usize| format!("GET /s/{} HTTP/1.1\r\n{host}\r\n", "a".repeat(bytes));
    let too_long = long(MOST_BYTES);
    let fields = format!("GET /s/ HTTP/1.1\r\n{host}{}\r\n", "a: b\r\n".repeat(MOST_FIELDS));
    let cases: [(&[u8], u32); 17] = [
        (b"\r\n\r\n", 400),
        (b"GET\r\n\r\n", 400),
        (b"GET /s/\r\n\r\n", 400),
        (b"GET /s/ FTP/1.1\r\nHost: localhost\r\n\r\n", 400),
        (b"GET /s/ HTTP/3.0\r\nHost: localhost\r\n\r\n", 400),
        (b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", 400),
        (b"GET * HTTP/1.1\r\nHost: localhost\r\n\r\n", 400),
        (b"GET /s/\xff\xfe HTTP/1.1\r\nHost: localhost\r\n\r\n", 400),
        (b"GET /s/ HTTP/1.1\r\nHost: \xff\xfe\r\n\r\n", 400),
        (b"GET /s/ HTTP/1.1\r\nHo\x00st: localhost\r\n\r\n", 400),
        (b"GET /s/ HTTP/1.1\r\nHost localhost\r\n\r\n", 400),
        (b"\x16\x03\x01\x02\x00\x01\x00\n\n\x01\xfc\x03\x03", 400),
        (b"BREW /s/ HTTP/1.1\r\nHost: localhost\r\n\r\n", 405),
        (b"get /s/ HTTP/1.1\r\nHost: localhost\r\n\r\n", 405),
        (too_long.as_bytes(), 431),
        (&[0xff; 40_000], 431),
        (fields.as_bytes(), 431),
    ];
    for (request, status) in cases {
        let answer = ask(address, request);
        println!("{:?}", String::from_utf8_lossy(&request[..request.len().min(40)]));
        assert_status(&answer, status);
    }
    // Nothing of it was too long, and pieces of any size are one request.
    assert_status(&ask(address, long(MOST_BYTES - 200).as_bytes()), 404);
    let mut stream = connect(address);
    for byte in b"GET /s/ HTTP/1.1\r\nHost: localhost\r\n\r\n" {
        stream.write_all(&[*byte]).expect("it reads");
    }
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("it answers");
    assert!(answer.ends_with("page"), "{answer}");
    assert_eq!(get(address, "/").lines().next(), Some("HTTP/1.1 200 OK"), "and the server goes on");
}

/// A byte now and then is no reason to wait longer.
#[test]
fn a_request_has_one_deadline() {
    let (address, site) = start(QUICK);
    let mut stream = connect(address);
    let mut slow = stream.try_clone().expect("a second handle");
    let began = Instant::now();
    let writer = std::thread::spawn(move || {
        while slow.write_all(b"G").is_ok() && began.elapsed() < Duration::from_secs(60) {
            std::thread::sleep(Duration::from_millis(20));
        }
    });
    let mut answer = vec![];
    // It may be reset behind the answer: the client goes on writing.
    let _ = stream.read_to_end(&mut answer);
    assert_status(&answer, 408);
    drop(stream);
    wait_until("the thread of a slow request ends", || threads(&site) == 0);
    writer.join().expect("it ends with the connection");
    assert!(began.elapsed() < Duration::from_secs(30), "{:?}", began.elapsed());
    let mut answer = vec![];
    connect(address).read_to_end(&mut answer).expect("an answer to nothing");
    assert_status(&answer, 408);
    wait_until("the thread of a silent client ends", || threads(&site) == 0);
}

#[test]
fn an_answer_has_one_deadline() {
    let (address, site) = start(QUICK);
    let mut stream = connect(address);
    stream.write_all(b"GET /s/huge HTTP/1.1\r\nHost: localhost\r\n\r\n").expect("it reads");
    let began = Instant::now();
    let mut piece = [0; 1000];
    stream.read_exact(&mut piece).expect("an answer begins");
    while threads(&site) > 0 {
        assert!(began.elapsed() < Duration::from_secs(60), "a slow reader keeps its thread");
        stream.read_exact(&mut piece).expect("there is more");
        std::thread::sleep(Duration::from_millis(20));
    }
    let mut rest = vec![];
    let _ = stream.read_to_end(&mut rest);
    assert!(rest.len() < BIG / 2, "the answer was cut off");
}

/// Of those that say nothing and of those that do not read.
#[test]
fn hundreds_of_slow_clients_shut_nobody_out() {
    let (address, site) = start(PATIENT);
    let slow: Vec<TcpStream> = (0..300)
        .map(|i| {
            let mut stream = connect(address);
            let request = if i % 2 == 0 { "GET /s/huge HTTP/1.1\r\nHost: localhost\r\n\r\n" } else { "GET /s/" };
            // Its place may be another's already.
            let _ = stream.write_all(request.as_bytes());
            stream
        })
        .collect();
    for _ in 0..20 {
        assert!(get(address, "/").ends_with("page"));
    }
    // Those that had to go have been woken up.
    wait_until("connections are bounded", || threads(&site) <= PATIENT.clients);
    assert!(threads(&site) >= PATIENT.clients / 2, "the others are still waited for");
    drop(slow);
    wait_until("all are gone", || threads(&site) == 0);
}

#[test]
fn clients_that_go_away_leave_the_server_alone() {
    let (address, site) = start(PATIENT);
    for _ in 0..20 {
        let mut stream = connect(address);
        stream.write_all(b"GET /s/huge HTTP/1.1\r\nHost: localhost\r\n\r\n").expect("it reads");
        // Closed in the middle of the answer.
        drop(stream);
    }
    assert!(get(address, "/").ends_with("page"));
    wait_until("all are gone", || threads(&site) == 0);
}

/// Answers when it is told to.
#[derive(Default)]
struct Gate(Mutex<bool>, Condvar);

impl Site for Gate {
    fn get(&self, _: &str, _: &str) -> Result<Answer<'_>, Refusal> {
        let open = self.0.lock().expect("nobody panics");
        drop(self.1.wait_while(open, |open| !*open).expect("nobody panics"));
        Ok(Answer { kind: "text/plain", gzip: false, bytes: Body::Borrowed(b"open") })
    }
}

/// Whoever waits for us keeps its place.
#[test]
fn where_all_wait_for_an_answer_others_are_told_to_come_again() {
    let (address, site) = start_with(Gate::default(), Limits { clients: 2, ..PATIENT });
    let waiting: Vec<_> = (0..2).map(|_| std::thread::spawn(move || get(address, "/"))).collect();
    wait_until("both are in", || threads(&site) == 2);
    // Until their requests are read they are clients that may go.
    std::thread::sleep(Duration::from_millis(500));
    assert_status(get(address, "/").as_bytes(), 503);
    *site.0.lock().expect("nobody panics") = true;
    site.1.notify_all();
    for answer in waiting {
        assert!(answer.join().expect("no panic").ends_with("open"));
    }
    assert!(get(address, "/").ends_with("open"));
}

#[test]
fn connections_wait_for_their_turn() {
    let pace = Duration::from_millis(20);
    let (address, _) = start(Limits { pace, ..PATIENT });
    let began = Instant::now();
    for _ in 0..BURST + 21 {
        assert!(get(address, "/").ends_with("page"));
    }
    assert!(began.elapsed() >= 20 * pace, "{:?}", began.elapsed());
}

#[test]
fn a_busy_port_is_an_error() {
    assert_eq!(bind(start(PATIENT).0).expect_err("in use").kind(), io::ErrorKind::AddrInUse);
}
