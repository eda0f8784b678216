//! A web server for a handful of files in memory, or what a [`Site`] makes of a request: GET and HEAD, and POST of JSON for
//! sites that take it, one answer per connection.
//!
//! Whatever clients send or do not send, they cost a bounded part of the machine ([`Limits`]): a connection has one deadline
//! for its request and one for taking the answer; where there are too many, the one that has used most of its time goes;
//! and only so many requests a second are looked at.
//!
//! Whoever can reach a port can ask: every user of the machine, and every page in their browsers. So a request must know the
//! server's [`Secret`], which is in the address that the program prints and opens, and no request learns anything without it.
//! A request must name this machine as its host. Otherwise the name of any web site could be pointed at the loopback
//! address, and its pages would read what is served here (DNS rebinding). Pages may load nothing from elsewhere
//! ([`POLICY`]), other sites may embed nothing from here, and what a browser asks for another site's page is refused. What is
//! posted must be JSON, which no other site's page sends unasked, and must not say that it comes from another site's page.

use std::collections::{BTreeMap, VecDeque};
use std::fs::File;
use std::io::{self, Read as _, Write as _};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use rand::RngExt as _;

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

/// The bytes of an answer. Large ones are not copied for a request.
#[derive(Debug)]
pub enum Body<'a> {
    /// The site's own.
    Borrowed(&'a [u8]),
    /// Made for this answer.
    Owned(Vec<u8>),
    /// Those of a resource that is shared.
    Shared(Arc<Resource>),
    /// A file of so many bytes, which is read while it is sent.
    File(File, u64),
}

impl Body<'_> {
    /// The number of bytes.
    fn len(&self) -> u64 {
        match self {
            Self::Borrowed(bytes) => bytes.len() as u64,
            Self::Owned(bytes) => bytes.len() as u64,
            Self::Shared(resource) => resource.bytes.len() as u64,
            Self::File(_, length) => *length,
        }
    }

    /// The same bytes without what the site lends.
    pub fn into_static(self) -> Body<'static> {
        match self {
            Self::Borrowed(bytes) => Body::Owned(bytes.to_vec()),
            Self::Owned(bytes) => Body::Owned(bytes),
            Self::Shared(resource) => Body::Shared(resource),
            Self::File(file, length) => Body::File(file, length),
        }
    }
}

/// What is answered with.
#[derive(Debug)]
pub struct Answer<'a> {
    /// Its media type.
    pub kind: &'static str,
    /// Whether the bytes are compressed, to be unpacked by the client.
    pub gzip: bool,
    /// Its bytes.
    pub bytes: Body<'a>,
}

/// The secret of a server: the first part of every path.
#[derive(Clone)]
pub struct Secret(String);

impl Secret {
    /// 128 random bits as hexadecimal digits.
    pub fn random() -> Self {
        Self(format!("{:032x}", rand::rng().random::<u128>()))
    }

    /// One that a test knows.
    #[cfg(test)]
    pub(crate) fn known(text: &str) -> Self {
        Self(text.into())
    }

    /// The address to open.
    pub fn url(&self, address: SocketAddr) -> String {
        format!("http://{address}/{}/", self.0)
    }

    /// A path without the secret; nothing where it is not in it.
    fn admits<'a>(&self, path: &'a str) -> Option<&'a str> {
        let end = path[1..].find('/')? + 1;
        same(&path[1..end], &self.0).then_some(&path[end..])
    }
}

/// Why there is no answer, as HTTP has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// The request makes no sense.
    BadRequest,
    /// There is nothing of this name.
    NotFound,
    /// The secret is not in the path, or another site's page asks.
    Forbidden,
    /// Only GET and HEAD are answered, and POST by sites that take it.
    Method,
    /// The request has not come to its end in time.
    Late,
    /// Not in the state that things are in.
    Conflict,
    /// There will be nothing more of this name.
    Gone,
    /// A POST does not say how long it is.
    NoLength,
    /// The body of a POST is too long.
    TooLarge,
    /// The body of a POST is no JSON.
    NoJson,
    /// The request is for another machine.
    OtherHost,
    /// The request is too long.
    TooLong,
    /// Not now.
    Busy,
}

impl Refusal {
    fn status(self) -> &'static str {
        match self {
            Self::BadRequest => "400 Bad Request",
            Self::Forbidden => "403 Forbidden",
            Self::NotFound => "404 Not Found",
            Self::Method => "405 Method Not Allowed",
            Self::Late => "408 Request Timeout",
            Self::Conflict => "409 Conflict",
            Self::Gone => "410 Gone",
            Self::NoLength => "411 Length Required",
            Self::TooLarge => "413 Content Too Large",
            Self::NoJson => "415 Unsupported Media Type",
            Self::OtherHost => "421 Misdirected Request",
            Self::TooLong => "431 Request Header Fields Too Large",
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

    /// Whether it takes what is posted.
    fn posts(&self) -> bool {
        false
    }

    /// Takes what was posted to a path.
    ///
    /// # Errors
    /// What is said to the client instead: a status and a sentence.
    fn post(&self, _path: &str, _body: &[u8]) -> Result<Answer<'_>, (Refusal, String)> {
        Err((Refusal::Method, String::new()))
    }
}

impl Site for Vec<Resource> {
    fn get(&self, path: &str, _query: &str) -> Result<Answer<'_>, Refusal> {
        let resource = self.iter().find(|resource| resource.path == path).ok_or(Refusal::NotFound)?;
        let Resource { kind, gzip, ref bytes, .. } = *resource;
        Ok(Answer { kind, gzip, bytes: Body::Borrowed(bytes) })
    }
}

/// How much of the machine clients may have.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Connections at once.
    pub clients: usize,
    /// Time for a request to come to its end.
    pub request: Duration,
    /// Time for an answer to be taken, besides that of its bytes.
    pub answer: Duration,
    /// Bytes of an answer per second that a client takes at least.
    pub rate: f64,
    /// Time between two connections, on average over `BURST` of them; others wait for their turn.
    pub pace: Duration,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            clients: 64,
            request: Duration::from_secs(10),
            answer: Duration::from_secs(10),
            // A scene of 100 MB over a slow line takes its half hour.
            rate: f64::from(64 << 10),
            // A connection costs some 0.1 ms of one core: a fiftieth of it at most.
            pace: Duration::from_millis(5),
        }
    }
}

/// Connections that need not wait for one another: more than a page has files.
const BURST: u32 = 32;
/// Longest head of a request that is read, bytes.
const MOST_BYTES: usize = 16 << 10;
/// Most fields of a head.
const MOST_FIELDS: usize = 64;
/// Longest body that is read, bytes.
const MOST_BODY: usize = 256 << 10;
/// What is still read of a request that was refused, bytes and time: closing a connection with unread bytes resets it, and
/// the refusal would be lost.
const REST: (usize, Duration) = (1 << 20, Duration::from_millis(500));
/// Answers are written in pieces of so many bytes, and the deadline is looked at before each.
const PIECE: usize = 64 << 10;

/// What pages may do: scripts and data come from the server itself or are made by the page (`blob:`), styles may stand in
/// elements. Nothing is loaded from or sent elsewhere, and no other site's page embeds them. The viewer compiles WebAssembly, and
/// the one handler that stands in its elements is named by its hash.
pub const POLICY: &str = "default-src 'none'; script-src 'self' blob: 'wasm-unsafe-eval' 'unsafe-hashes' \
    'sha256-jHF5hTIlMDyGZRAsNK0HO/WFYrwPvI2I1q0o1xKKB6I='; style-src 'self' 'unsafe-inline'; \
    img-src 'self' blob: data:; font-src 'self' data:; connect-src 'self' blob: data:; worker-src 'self' blob:; \
    frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'";

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
pub fn serve(listener: &TcpListener, site: &Arc<impl Site>, secret: &Secret) -> io::Result<()> {
    serve_within(listener, site, secret, Limits::default())
}

/// [`serve`] with limits of one's own.
///
/// # Errors
/// As [`serve`].
pub fn serve_within(listener: &TcpListener, site: &Arc<impl Site>, secret: &Secret, limits: Limits) -> io::Result<()> {
    let clients = Arc::new(Clients::default());
    // Kept for a while: their requests are unread, see [`REST`].
    let mut turned_away = VecDeque::new();
    let mut next = Instant::now();
    loop {
        // Connections that are not accepted yet wait in the system.
        let now = Instant::now();
        next = now.checked_sub(limits.pace * BURST).map_or(next, |earliest| next.max(earliest)) + limits.pace;
        std::thread::sleep(next.saturating_duration_since(now));
        // A client that is gone again, or a moment without file handles, is none of the others' business.
        let Ok((stream, _)) = listener.accept() else {
            std::thread::sleep(Duration::from_millis(50));
            continue;
        };
        let stream = Arc::new(stream);
        let Some(number) = clients.admit(&stream, limits) else {
            // A new connection has room for it.
            let _ = stream.set_nonblocking(true);
            let _ = (&*stream).write_all(&refusal(Refusal::Busy)).and_then(|()| stream.shutdown(Shutdown::Write));
            turned_away.push_back(stream);
            if turned_away.len() > limits.clients {
                turned_away.pop_front();
            }
            continue;
        };
        let (site, secret, clients) = (site.clone(), secret.clone(), clients.clone());
        let client = Client { site, secret, clients, number, limits, stream };
        // Errors are the client's: it went away. Without a thread for it, it is as good as gone.
        let _ = std::thread::Builder::new().spawn(move || client.talk());
    }
}

/// The connections there are, by number in their order.
#[derive(Default)]
struct Clients(Mutex<(u64, BTreeMap<u64, Connection>)>);

struct Connection {
    stream: Arc<TcpStream>,
    /// Since when the client has been waited for, and for how long that may be; nothing while it waits for us.
    waited_for: Option<(Instant, Duration)>,
}

impl Connection {
    /// Part of its time that a client has used.
    fn used(&self) -> Option<f64> {
        self.waited_for.map(|(since, time)| since.elapsed().as_secs_f64() / time.as_secs_f64())
    }
}

impl Clients {
    /// What a thread that panicked has left is whole: every change is one call.
    fn lock(&self) -> MutexGuard<'_, (u64, BTreeMap<u64, Connection>)> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a connection in, in place of the slowest client's where there are too many; none where all wait for us.
    fn admit(&self, stream: &Arc<TcpStream>, limits: Limits) -> Option<u64> {
        let (last, all) = &mut *self.lock();
        if all.len() >= limits.clients {
            let used = all.iter().filter_map(|(number, connection)| Some((connection.used()?, *number)));
            let (_, slowest) = used.max_by(|a, b| a.0.total_cmp(&b.0))?;
            // Its thread wakes up to a closed connection.
            let _ = all.remove(&slowest).map(|gone| gone.stream.shutdown(Shutdown::Both));
        }
        *last += 1;
        all.insert(*last, Connection { stream: stream.clone(), waited_for: Some((Instant::now(), limits.request)) });
        Some(*last)
    }
}

/// One connection; it is counted until this is gone.
struct Client<S> {
    site: Arc<S>,
    secret: Secret,
    clients: Arc<Clients>,
    number: u64,
    limits: Limits,
    stream: Arc<TcpStream>,
}

impl<S> Drop for Client<S> {
    fn drop(&mut self) {
        self.clients.lock().1.remove(&self.number);
    }
}

impl<S: Site> Client<S> {
    fn waits(&self, time: Option<Duration>) {
        if let Some(connection) = self.clients.lock().1.get_mut(&self.number) {
            connection.waited_for = time.map(|time| (Instant::now(), time));
        }
    }

    fn talk(&self) -> io::Result<()> {
        // Answers are written whole: nothing is gained by waiting for more.
        self.stream.set_nodelay(true)?;
        let request = self.request(Instant::now() + self.limits.request)?;
        self.waits(None);
        let answered = match request {
            Ok(head) => self.answered(&head)?,
            Err(refused) => Err((refused, String::new())),
        };
        let (method, answer) = match answered {
            Ok(answered) => answered,
            Err((refused, why)) => {
                self.waits(Some(self.limits.answer));
                let text = if why.is_empty() { refusal(refused) } else { refusal_because(refused, &why) };
                self.write(&text, Instant::now() + self.limits.answer)?;
                return self.drain();
            }
        };
        let length = answer.bytes.len();
        let head = head("200 OK", answer.kind, length, answer.gzip);
        let sent = if method == Method::Head { 0 } else { length };
        let time = self.limits.answer + Duration::from_secs_f64(sent as f64 / self.limits.rate);
        self.waits(Some(time));
        let until = Instant::now() + time;
        let bytes = match &answer.bytes {
            _ if sent == 0 => &[],
            Body::Borrowed(bytes) => *bytes,
            Body::Owned(bytes) => bytes,
            Body::Shared(resource) => &resource.bytes,
            Body::File(file, length) => {
                self.write(head.as_bytes(), until)?;
                return self.copy(file, *length, until);
            }
        };
        if bytes.len() < PIECE {
            return self.write(&[head.as_bytes(), bytes].concat(), until);
        }
        self.write(head.as_bytes(), until)?;
        self.write(bytes, until)
    }

    /// Sends so many bytes of a file. One that has become shorter ends the connection early, which the client notices.
    fn copy(&self, mut file: &File, length: u64, until: Instant) -> io::Result<()> {
        let mut piece = vec![0; PIECE];
        let mut left = length;
        while left > 0 {
            let most = usize::try_from(left).unwrap_or(PIECE).min(PIECE);
            let read = file.read(&mut piece[..most])?;
            if read == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            self.write(&piece[..read], until)?;
            left -= read as u64;
        }
        Ok(())
    }

    /// Reads the head of a request.
    fn request(&self, until: Instant) -> io::Result<Result<Vec<u8>, Refusal>> {
        let mut head = Vec::with_capacity(1024);
        let mut piece = [0; 4096];
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(Err(Refusal::Late));
            }
            self.stream.set_read_timeout(Some(left))?;
            let read = match (&*self.stream).read(&mut piece) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(read) => read,
                Err(error) if is_pause(&error) => continue,
                Err(error) => return Err(error),
            };
            // The end of the head may lie across two pieces.
            let from = head.len().saturating_sub(2);
            head.extend_from_slice(&piece[..read]);
            let new = &head[from..];
            let ends = |end: &[u8]| new.windows(end.len()).any(|window| window == end);
            if head.len() > MOST_BYTES {
                return Ok(Err(Refusal::TooLong));
            }
            if ends(b"\n\n") || ends(b"\n\r\n") {
                return Ok(Ok(head));
            }
        }
    }

    /// The answer to a request, of whose body `head` may have the beginning.
    fn answered(&self, head: &[u8]) -> io::Result<Answered<'_>> {
        let mut fields = [httparse::EMPTY_HEADER; MOST_FIELDS];
        let plain = |refused| Ok(Err((refused, String::new())));
        let asked = Request::parse(head, &mut fields).and_then(|request| {
            // Behind some addresses there is more than one of this machine's: the client has chosen which.
            let ours = self.stream.local_addr().map_or(Ipv4Addr::LOCALHOST.into(), |address| address.ip());
            if !names(request.field("host")?.ok_or(Refusal::BadRequest)?, ours) {
                return Err(Refusal::OtherHost);
            }
            // A browser says for whose page it asks.
            if request.field("sec-fetch-site")?.is_some_and(|site| site.eq_ignore_ascii_case("cross-site")) {
                return Err(Refusal::Forbidden);
            }
            let path = self.secret.admits(request.path).ok_or(Refusal::Forbidden)?;
            let method = request.method.ok_or(Refusal::Method)?;
            let length = if method == Method::Post { Some(self.may_post(&request, ours)?) } else { None };
            Ok((request, path, method, length))
        });
        let (request, path, method, length) = match asked {
            Ok(asked) => asked,
            Err(refused) => return plain(refused),
        };
        let Some(length) = length else {
            return Ok(self.site.get(path, request.query).map_err(|r| (r, String::new())).map(|a| (method, a)));
        };
        self.waits(Some(self.limits.request));
        let body = self.body(&head[request.length..], length, Instant::now() + self.limits.request)?;
        self.waits(None);
        match body {
            Ok(body) => Ok(self.site.post(path, &body).map(|answer| (method, answer))),
            Err(refused) => plain(refused),
        }
    }

    /// The length of a body that is taken.
    fn may_post(&self, request: &Request<'_>, ours: IpAddr) -> Result<usize, Refusal> {
        if !self.site.posts() {
            return Err(Refusal::Method);
        }
        // A browser says whose page it is.
        let foreign = request.field("origin")?.is_some_and(|origin| {
            let host = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
            !host.is_some_and(|host| names(host, ours))
        });
        if foreign {
            return Err(Refusal::Forbidden);
        }
        let kind = request.field("content-type")?.unwrap_or_default();
        if !kind.split(';').next().unwrap_or_default().trim().eq_ignore_ascii_case("application/json") {
            return Err(Refusal::NoJson);
        }
        if request.field("transfer-encoding")?.is_some() {
            return Err(Refusal::NoLength);
        }
        let length = request.field("content-length")?.ok_or(Refusal::NoLength)?;
        let length = Some(length).filter(|digits| digits.bytes().all(|digit| digit.is_ascii_digit()));
        let length = length.and_then(|digits| digits.parse::<u64>().ok()).ok_or(Refusal::BadRequest)?;
        usize::try_from(length).ok().filter(|length| *length <= MOST_BODY).ok_or(Refusal::TooLarge)
    }

    /// Reads a body of so many bytes that begins with these.
    fn body(&self, begun: &[u8], length: usize, until: Instant) -> io::Result<Result<Vec<u8>, Refusal>> {
        let mut body = begun[..begun.len().min(length)].to_vec();
        let mut piece = [0; 4096];
        while body.len() < length {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(Err(Refusal::Late));
            }
            self.stream.set_read_timeout(Some(left))?;
            let most = piece.len().min(length - body.len());
            match (&*self.stream).read(&mut piece[..most]) {
                Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
                Ok(read) => body.extend_from_slice(&piece[..read]),
                Err(error) if is_pause(&error) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(Ok(body))
    }

    fn write(&self, bytes: &[u8], until: Instant) -> io::Result<()> {
        let mut rest = bytes;
        while !rest.is_empty() {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(io::ErrorKind::TimedOut.into());
            }
            self.stream.set_write_timeout(Some(left))?;
            match (&*self.stream).write(&rest[..rest.len().min(PIECE)]) {
                Ok(0) => return Err(io::ErrorKind::WriteZero.into()),
                Ok(written) => rest = &rest[written..],
                Err(error) if is_pause(&error) => {}
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Reads what is left of a request that was refused, see [`REST`].
    fn drain(&self) -> io::Result<()> {
        self.stream.shutdown(Shutdown::Write)?;
        let (bytes, time) = REST;
        let until = Instant::now() + time;
        let mut piece = [0; 4096];
        for _ in 0..bytes / piece.len() {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                break;
            }
            self.stream.set_read_timeout(Some(left))?;
            if (&*self.stream).read(&mut piece)? == 0 {
                break;
            }
        }
        Ok(())
    }
}

/// Whether a call may be made again: its time was over, or a signal came.
fn is_pause(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut | io::ErrorKind::Interrupted)
}

/// The outcome of a request: how it was asked and the answer, or a status and what is said with it.
type Answered<'a> = Result<(Method, Answer<'a>), (Refusal, String)>;

/// Whether two words are the same, in a time that does not say where they differ.
fn same(a: &str, b: &str) -> bool {
    a.len() == b.len() && a.bytes().zip(b.bytes()).fold(0, |sum, (a, b)| sum | (a ^ b)) == 0
}

/// What may be asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Method {
    Get,
    Head,
    Post,
}

/// The head of a request.
struct Request<'a> {
    /// Nothing where it is none that is known here.
    method: Option<Method>,
    path: &'a str,
    query: &'a str,
    /// Bytes of the head.
    length: usize,
    fields: &'a [httparse::Header<'a>],
}

impl<'a> Request<'a> {
    fn parse(head: &'a [u8], fields: &'a mut [httparse::Header<'a>]) -> Result<Self, Refusal> {
        let mut request = httparse::Request::new(fields);
        let length = match request.parse(head) {
            Ok(httparse::Status::Complete(length)) => length,
            Err(httparse::Error::TooManyHeaders) => return Err(Refusal::TooLong),
            Ok(httparse::Status::Partial) | Err(_) => return Err(Refusal::BadRequest),
        };
        let target = request.path.filter(|path| path.starts_with('/')).ok_or(Refusal::BadRequest)?;
        let target = target.split('#').next().unwrap_or_default();
        let (path, query) = target.split_once('?').unwrap_or((target, ""));
        let method = match request.method {
            Some("GET") => Some(Method::Get),
            Some("HEAD") => Some(Method::Head),
            Some("POST") => Some(Method::Post),
            _ => None,
        };
        Ok(Self { method, path, query, length, fields: request.headers })
    }

    /// The field of this name, which is there once at most.
    fn field(&self, name: &str) -> Result<Option<&'a str>, Refusal> {
        let mut all = self.fields.iter().filter(|field| field.name.eq_ignore_ascii_case(name));
        let Some(field) = all.next() else { return Ok(None) };
        let text = std::str::from_utf8(field.value).map_err(|_| Refusal::BadRequest)?;
        if all.next().is_some() { Err(Refusal::BadRequest) } else { Ok(Some(text.trim())) }
    }
}

/// Whether the field `Host` names this machine: as localhost, by a loopback address, or by the address that the client
/// has connected to. The port is not compared: it is another one behind `ssh -L`.
fn names(host: &str, ours: IpAddr) -> bool {
    let (name, port) = match host.strip_prefix('[').and_then(|host| host.split_once(']')) {
        Some((name, port)) => (name, port),
        None => host.split_at(host.find(':').unwrap_or(host.len())),
    };
    let port = port.is_empty() || port.strip_prefix(':').is_some_and(|digits| digits.parse::<u16>().is_ok());
    let address: Option<IpAddr> = if host.starts_with('[') {
        name.parse::<Ipv6Addr>().ok().map(Into::into)
    } else {
        name.parse::<Ipv4Addr>().ok().map(Into::into)
    };
    let loopback: [IpAddr; 2] = [Ipv4Addr::LOCALHOST.into(), Ipv6Addr::LOCALHOST.into()];
    let address = address.map(|address| address.to_canonical());
    let ours = |address: IpAddr| loopback.contains(&address) || address == ours.to_canonical();
    port && (name.eq_ignore_ascii_case("localhost") || address.is_some_and(ours))
}

fn head(status: &str, kind: &str, bytes: u64, gzip: bool) -> String {
    let encoding = if gzip { "Content-Encoding: gzip\r\n" } else { "" };
    format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {bytes}\r\n{encoding}Cache-Control: no-store\r\n\
         Content-Security-Policy: {POLICY}\r\nCross-Origin-Resource-Policy: same-origin\r\nReferrer-Policy: no-referrer\r\n\
         X-Content-Type-Options: nosniff\r\nConnection: close\r\n\r\n"
    )
}

fn refusal(refusal: Refusal) -> Vec<u8> {
    let status = refusal.status();
    let text = match refusal {
        Refusal::OtherHost => format!("{status}: open it as localhost or by its address\n"),
        Refusal::Forbidden => format!("{status}: open the whole address that the program has printed\n"),
        _ => format!("{status}\n"),
    };
    (head(status, "text/plain", text.len() as u64, false) + &text).into_bytes()
}

/// A refusal that says why, in a sentence.
fn refusal_because(refusal: Refusal, why: &str) -> Vec<u8> {
    let text = format!("{why}\n");
    (head(refusal.status(), "text/plain; charset=utf-8", text.len() as u64, false) + &text).into_bytes()
}

#[cfg(test)]
mod tests;
