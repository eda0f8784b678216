//! A disk that fails, as a library that the loader puts before the system's: from some change of a folder on, every change
//! of it is refused. `tests/faults.rs` compiles it; it needs no rights.
//!
//! - `FAULT_BELOW`: the folder, absolute.
//! - `FAULT_FROM`: the first change that is refused, counted from 1; 0 for none.
//! - `FAULT_ONCE`: set where the next change succeeds again.
//! - `FAULT_ERRNO`: what the system says. 28, no room, leaves renaming and removing possible.
//! - `FAULT_COUNT`: a file that gets a byte for each change.

use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};

unsafe extern "C" {
    fn dlsym(handle: *mut c_void, name: *const c_char) -> *mut c_void;
    fn getenv(name: *const c_char) -> *const c_char;
    fn readlink(path: *const c_char, into: *mut c_char, size: usize) -> isize;
    fn getcwd(into: *mut c_char, size: usize) -> *mut c_char;
    fn __errno_location() -> *mut c_int;
}

/// `RTLD_NEXT`.
const NEXT: *mut c_void = -1isize as *mut c_void;
const AT_FDCWD: c_int = -100;
const O_ACCMODE: c_int = 0o3;
const O_CREAT: c_int = 0o100;
const ENOSPC: c_int = 28;

struct Fault {
    below: Vec<u8>,
    from: usize,
    once: bool,
    errno: c_int,
    /// A descriptor, or -1.
    count: c_int,
}

static FAULT: OnceLock<Option<Fault>> = OnceLock::new();
static CHANGES: AtomicUsize = AtomicUsize::new(0);

/// The system's own function of a name.
macro_rules! next {
    ($name:literal, fn($($argument:ty),* $(,)?) -> $result:ty) => {{
        static FOUND: OnceLock<usize> = OnceLock::new();
        let found = *FOUND.get_or_init(|| unsafe { dlsym(NEXT, concat!($name, "\0").as_ptr().cast()) } as usize);
        unsafe { std::mem::transmute::<usize, extern "C" fn($($argument),*) -> $result>(found) }
    }};
}

fn variable(name: &CStr) -> Option<Vec<u8>> {
    let value = unsafe { getenv(name.as_ptr()) };
    (!value.is_null()).then(|| unsafe { CStr::from_ptr(value) }.to_bytes().to_vec())
}

fn number(name: &CStr) -> Option<usize> {
    std::str::from_utf8(&variable(name)?).ok()?.parse().ok()
}

fn fault() -> Option<&'static Fault> {
    let read = || {
        let open = |mut path: Vec<u8>| {
            path.push(0);
            // Written to, made if missing, appended to.
            next!("open", fn(*const c_char, c_int, c_uint) -> c_int)(path.as_ptr().cast(), 0o2101, 0o644)
        };
        Some(Fault {
            below: variable(c"FAULT_BELOW")?,
            from: number(c"FAULT_FROM").unwrap_or(0),
            once: variable(c"FAULT_ONCE").is_some(),
            errno: number(c"FAULT_ERRNO").unwrap_or(5) as c_int,
            count: variable(c"FAULT_COUNT").map_or(-1, open),
        })
    };
    FAULT.get_or_init(read).as_ref()
}

fn link(path: &[u8]) -> Vec<u8> {
    let mut into = vec![0u8; 4096];
    let len = unsafe { readlink(path.as_ptr().cast(), into.as_mut_ptr().cast(), into.len()) };
    into.truncate(len.max(0) as usize);
    into
}

fn of_descriptor(descriptor: c_int) -> Vec<u8> {
    link(format!("/proc/self/fd/{descriptor}\0").as_bytes())
}

/// A path as it was given, from the root.
fn absolute(folder: c_int, path: *const c_char) -> Vec<u8> {
    let path = unsafe { CStr::from_ptr(path) }.to_bytes();
    if path.first() == Some(&b'/') {
        return path.to_vec();
    }
    let mut whole = if folder == AT_FDCWD {
        let mut into = vec![0u8; 4096];
        unsafe { getcwd(into.as_mut_ptr().cast(), into.len()) };
        into.truncate(into.iter().position(|byte| *byte == 0).unwrap_or(0));
        into
    } else {
        of_descriptor(folder)
    };
    whole.push(b'/');
    whole.extend(path);
    whole
}

/// Whether a change of this path is refused; `grows` where it needs room.
fn refused(path: impl FnOnce() -> Vec<u8>, grows: bool) -> bool {
    let Some(fault) = fault() else { return false };
    if !grows && fault.errno == ENOSPC || !path().starts_with(&fault.below) {
        return false;
    }
    let change = CHANGES.fetch_add(1, Ordering::SeqCst) + 1;
    if fault.count >= 0 {
        next!("write", fn(c_int, *const c_void, usize) -> isize)(fault.count, b".".as_ptr().cast(), 1);
    }
    let refused = fault.from > 0 && if fault.once { change == fault.from } else { change >= fault.from };
    if refused {
        unsafe { *__errno_location() = fault.errno };
    }
    refused
}

/// Functions whose first argument is the descriptor of the file they write to.
macro_rules! writes {
    ($($name:ident, $text:literal, ($($argument:ident: $type:ty),*) -> $result:ty;)*) => {
        $(#[unsafe(no_mangle)]
        pub extern "C" fn $name(to: c_int, $($argument: $type),*) -> $result {
            if refused(|| of_descriptor(to), true) {
                return -1;
            }
            next!($text, fn(c_int, $($type),*) -> $result)(to, $($argument),*)
        })*
    };
}

writes! {
    write, "write", (bytes: *const c_void, len: usize) -> isize;
    writev, "writev", (parts: *const c_void, count: c_int) -> isize;
    pwrite64, "pwrite64", (bytes: *const c_void, len: usize, at: i64) -> isize;
    sendfile, "sendfile", (from: c_int, at: *mut c_void, len: usize) -> isize;
    sendfile64, "sendfile64", (from: c_int, at: *mut c_void, len: usize) -> isize;
    fsync, "fsync", () -> c_int;
    fdatasync, "fdatasync", () -> c_int;
}

#[unsafe(no_mangle)]
pub extern "C" fn copy_file_range(
    from: c_int,
    from_at: *mut c_void,
    to: c_int,
    to_at: *mut c_void,
    len: usize,
    flags: c_uint,
) -> isize {
    if refused(|| of_descriptor(to), true) {
        return -1;
    }
    next!("copy_file_range", fn(c_int, *mut c_void, c_int, *mut c_void, usize, c_uint) -> isize)(
        from, from_at, to, to_at, len, flags,
    )
}

fn opens_to_change(flags: c_int) -> bool {
    flags & O_CREAT != 0 || flags & O_ACCMODE != 0
}

macro_rules! opens {
    ($($name:ident, $text:literal;)*) => {
        $(#[unsafe(no_mangle)]
        pub extern "C" fn $name(path: *const c_char, flags: c_int, mode: c_uint) -> c_int {
            if opens_to_change(flags) && refused(|| absolute(AT_FDCWD, path), flags & O_CREAT != 0) {
                return -1;
            }
            next!($text, fn(*const c_char, c_int, c_uint) -> c_int)(path, flags, mode)
        })*
    };
}

opens! { open, "open"; open64, "open64"; }

macro_rules! opens_at {
    ($($name:ident, $text:literal;)*) => {
        $(#[unsafe(no_mangle)]
        pub extern "C" fn $name(folder: c_int, path: *const c_char, flags: c_int, mode: c_uint) -> c_int {
            if opens_to_change(flags) && refused(|| absolute(folder, path), flags & O_CREAT != 0) {
                return -1;
            }
            next!($text, fn(c_int, *const c_char, c_int, c_uint) -> c_int)(folder, path, flags, mode)
        })*
    };
}

opens_at! { openat, "openat"; openat64, "openat64"; }

#[unsafe(no_mangle)]
pub extern "C" fn mkdir(path: *const c_char, mode: c_uint) -> c_int {
    if refused(|| absolute(AT_FDCWD, path), true) {
        return -1;
    }
    next!("mkdir", fn(*const c_char, c_uint) -> c_int)(path, mode)
}

/// Functions that change a folder and need no room.
macro_rules! changes {
    ($($name:ident, $text:literal, $folder:expr, ($($argument:ident: $type:ty),*);)*) => {
        $(#[unsafe(no_mangle)]
        pub extern "C" fn $name($($argument: $type),*) -> c_int {
            if refused($folder, false) {
                return -1;
            }
            next!($text, fn($($type),*) -> c_int)($($argument),*)
        })*
    };
}

changes! {
    rename, "rename", || absolute(AT_FDCWD, to), (from: *const c_char, to: *const c_char);
    renameat, "renameat", || absolute(to_folder, to),
        (from_folder: c_int, from: *const c_char, to_folder: c_int, to: *const c_char);
    unlink, "unlink", || absolute(AT_FDCWD, path), (path: *const c_char);
    unlinkat, "unlinkat", || absolute(folder, path), (folder: c_int, path: *const c_char, flags: c_int);
    rmdir, "rmdir", || absolute(AT_FDCWD, path), (path: *const c_char);
}
