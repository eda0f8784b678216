//! A web server for a handful of files in memory, or what a [`Site`] makes of a request: GET and HEAD, one answer per
//! connection.
//!
//! Whatever a client sends or does not send costs a thread for ten seconds at most and nothing else.

use std::borrow::Cow;
use std::io::{self, BufRead as _, BufReader, Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

/// A file to serve.
#[derive(Debug, Clone)]
pub struct Resource {
    /// Its path, from `/` on.
    pub path: &'static str,
    /// Its media type.
    pub kind: &'static str,
    /// Whether the bytes are compressed, to be unpacked by the client.
    pub gzip: bool,
    /// Its bytes.
    pub bytes: Vec<u8>,
}

/// What is answered with.
#[derive(Debug)]
pub struct Answer<'a> {
    /// Its media type.
    pub kind: &'static str,
    /// Whether the bytes are compressed, to be unpacked by the client.
    pub gzip: bool,
    /// Its bytes.
    pub bytes: Cow<'a, [u8]>,
}

/// Why there is no answer, as HTTP has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// The request makes no sense.
    BadRequest,
    /// There is nothing of this name.
    NotFound,
    /// There will be nothing more of this name.
    Gone,
    /// Not now.
    Busy,
}

impl Refusal {
    fn status(self) -> &'static str {
        match self {
            Self::BadRequest => "400 Bad Request",
            Self::NotFound => "404 Not Found",
            Self::Gone => "410 Gone",
            Self::Busy => "503 Service Unavailable",
        }
    }
}

/// What a server shows.
pub trait Site: Send + Sync + 'static {
    /// What is at a path, `/` first, with a query (what follows a `?`). It may take its time: every client has a thread.
    ///
    /// # Errors
    /// What is said to the client instead.
    fn get(&self, path: &str, query: &str) -> Result<Answer<'_>, Refusal>;
}

impl Site for Vec<Resource> {
    fn get(&self, path: &str, _query: &str) -> Result<Answer<'_>, Refusal> {
        let resource = self.iter().find(|resource| resource.path == path).ok_or(Refusal::NotFound)?;
        let Resource { kind, gzip, ref bytes, .. } = *resource;
        Ok(Answer { kind, gzip, bytes: Cow::Borrowed(bytes) })
    }
}

/// Longest request head that is read.
const MOST_BYTES: u64 = 16 << 10;
/// Connections at once; more are told to come again.
const MOST_CLIENTS: usize = 64;
/// How long a client may take over its request, and over each part of the answer.
const PATIENCE: Duration = Duration::from_secs(10);

/// Binds the address; port 0 is any free one.
///
/// # Errors
/// An address in use, or not this machine's.
pub fn bind(address: SocketAddr) -> io::Result<TcpListener> {
    TcpListener::bind(address)
}

/// Serves until the process ends.
///
/// # Errors
/// Never while the listener is whole.
pub fn serve(listener: &TcpListener, site: &Arc<impl Site>) -> io::Result<()> {
    let clients = Arc::new(AtomicUsize::new(0));
    loop {
        // A client that is gone again, or a moment without file handles, is none of the others' business.
        let Ok((stream, _)) = listener.accept() else {
            std::thread::sleep(Duration::from_millis(50));
            continue;
        };
        let before = clients.fetch_add(1, Ordering::Relaxed);
        let client = Client { site: site.clone(), clients: clients.clone() };
        let busy = before >= MOST_CLIENTS;
        // Errors are the client's: it went away. Without a thread for it, it is as good as gone.
        let _ = std::thread::Builder::new().spawn(move || client.answer(&stream, busy));
    }
}

/// One connection; it is counted until this is gone.
struct Client<S> {
    site: Arc<S>,
    clients: Arc<AtomicUsize>,
}

impl<S> Drop for Client<S> {
    fn drop(&mut self) {
        self.clients.fetch_sub(1, Ordering::Relaxed);
    }
}

impl<S: Site> Client<S> {
    fn answer(&self, stream: &TcpStream, busy: bool) -> io::Result<()> {
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        if busy {
            return refuse(stream, Refusal::Busy.status());
        }
        answer(stream, &*self.site)
    }
}

fn answer(mut stream: &TcpStream, site: &impl Site) -> io::Result<()> {
    let mut head = BufReader::new(stream.take(MOST_BYTES));
    let mut request = String::new();
    head.read_line(&mut request)?;
    // The rest of the head is read, so that closing the connection does not reset it, and not used.
    let mut line = String::new();
    while head.read_line(&mut line)? > 2 {
        line.clear();
    }
    let mut words = request.split_whitespace();
    let (method, target) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
    if !words.next().is_some_and(|version| version.starts_with("HTTP/1.")) {
        return refuse(stream, "400 Bad Request");
    }
    if !matches!(method, "GET" | "HEAD") {
        return refuse(stream, "405 Method Not Allowed");
    }
    let target = target.split('#').next().unwrap_or_default();
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    let answer = match site.get(path, query) {
        Ok(answer) => answer,
        Err(refusal) => return refuse(stream, refusal.status()),
    };
    let encoding = if answer.gzip { "Content-Encoding: gzip\r\n" } else { "" };
    write!(
        stream,
        "HTTP/1.1 200 OK\r\nContent-Type: {}\r\nContent-Length: {}\r\n{encoding}Cache-Control: no-store\r\nConnection: close\r\n\r\n",
        answer.kind,
        answer.bytes.len()
    )?;
    if method == "GET" {
        stream.write_all(&answer.bytes)?;
    }
    stream.flush()
}

fn refuse(mut stream: &TcpStream, status: &str) -> io::Result<()> {
    write!(
        stream,
        "HTTP/1.1 {status}\r\nContent-Type: text/plain\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{status}\n",
        status.len() + 1
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn start() -> SocketAddr {
        let listener = bind(([127, 0, 0, 1], 0).into()).expect("a free port");
        let address = listener.local_addr().expect("it is bound");
        let file = |path, gzip, bytes: &[u8]| Resource { path, kind: "text/plain", gzip, bytes: bytes.to_vec() };
        let resources = vec![file("/", false, b"page"), file("/big", true, &vec![b'Q'; 3_000_000])];
        std::thread::spawn(move || serve(&listener, &Arc::new(resources)));
        address
    }

    fn ask(address: SocketAddr, request: &[u8]) -> String {
        let mut stream = TcpStream::connect(address).expect("the server listens");
        stream.write_all(request).expect("the server reads");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("the server answers");
        answer
    }

    #[test]
    fn files_are_served_and_nothing_else() {
        let address = start();
        let page = ask(address, b"GET /?noui HTTP/1.1\r\nHost: here\r\n\r\n");
        assert!(page.starts_with("HTTP/1.1 200 OK\r\n") && page.ends_with("\r\n\r\npage"), "{page}");
        let head = ask(address, b"HEAD /big HTTP/1.1\r\n\r\n");
        assert!(head.contains("Content-Encoding: gzip\r\n") && head.ends_with("\r\n\r\n"), "{head}");
        assert_eq!(ask(address, b"GET /big HTTP/1.0\r\n\r\n").matches('Q').count(), 3_000_000);
        for (request, status) in [
            (b"GET /../etc/passwd HTTP/1.1\r\n\r\n".as_slice(), "404"),
            (b"POST / HTTP/1.1\r\n\r\n", "405"),
            (b"\r\n\r\n", "400"),
            (b"GET /\r\n\r\n", "400"),
        ] {
            let answer = ask(address, request);
            assert!(answer.starts_with(&format!("HTTP/1.1 {status} ")), "{answer}");
        }
    }

    #[test]
    fn clients_that_go_away_or_never_ask_leave_the_server_alone() {
        let address = start();
        let silent: Vec<TcpStream> = (0..20).map(|_| TcpStream::connect(address).expect("it listens")).collect();
        for _ in 0..20 {
            let mut stream = TcpStream::connect(address).expect("it listens");
            stream.write_all(b"GET /big HTTP/1.1\r\n\r\n").expect("it reads");
            // Closed in the middle of the answer.
            drop(stream);
        }
        // Not text, and a head without an end.
        let mut stream = TcpStream::connect(address).expect("it listens");
        let _ = stream.write_all(&[0xff; 40_000]);
        drop(stream);
        assert!(ask(address, b"GET / HTTP/1.1\r\n\r\n").ends_with("page"));
        drop(silent);
    }

    #[test]
    fn a_busy_port_is_an_error() {
        assert_eq!(bind(start()).expect_err("in use").kind(), io::ErrorKind::AddrInUse);
    }
}
