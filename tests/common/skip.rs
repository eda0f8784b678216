//! A test that has nothing to look at says so where it is heard.

use std::io::Write as _;

/// What a machine can lack.
#[allow(dead_code)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lack {
    /// The folder of real captures.
    Captures,
    /// The npm packages of tests/viewer.
    Node,
    /// A browser of Chromium's kind.
    Browser,
    /// Mesa's lavapipe, as a file of the Vulkan loader.
    Lavapipe,
    /// Mesa's RADV.
    Radv,
    /// RADV of the version that the table of registers is of.
    RadvTable,
    /// SwiftShader.
    SwiftShader,
    /// Push descriptors.
    PushDescriptors,
    /// Subgroups of eight threads.
    SubgroupsOf8,
    /// Timestamps on the device.
    Timestamps,
    /// Device memory that is not made of files: a limit of files ends the program.
    MemoryWithoutFiles,
    /// Snakemake.
    Snakemake,
    /// A golden case, where `GSCREAM_GOLDEN` names a folder of some kinds.
    GoldenCase,
    /// What a process's memory is, from the system.
    ProcessMemory,
    /// The program `ffmpeg`.
    Ffmpeg,
    /// `rustc`, which the tests of a failing disk and of a failing driver compile a library with.
    Compiler,
}

impl Lack {
    /// As `GSCREAM_MAY_LACK` has it.
    fn name(self) -> &'static str {
        match self {
            Self::Captures => "captures",
            Self::Node => "node",
            Self::Browser => "browser",
            Self::Lavapipe => "lavapipe",
            Self::Radv => "radv",
            Self::RadvTable => "radv-table",
            Self::SwiftShader => "swiftshader",
            Self::PushDescriptors => "push-descriptors",
            Self::SubgroupsOf8 => "subgroups-of-8",
            Self::Timestamps => "timestamps",
            Self::MemoryWithoutFiles => "memory-without-files",
            Self::Snakemake => "snakemake",
            Self::GoldenCase => "golden-case",
            Self::ProcessMemory => "process-memory",
            Self::Ffmpeg => "ffmpeg",
            Self::Compiler => "compiler",
        }
    }
}

/// Says that a test, or what follows in it, is skipped: past the harness, which hides what passing tests print, and as a
/// line of the file that `GSCREAM_SKIPS` names.
///
/// # Panics
/// With `CI=true`, unless `GSCREAM_MAY_LACK` lists it.
pub fn skip(lack: Lack, why: &str) {
    let thread = std::thread::current();
    let line = format!("skipped: {}: {why} ({})\n", thread.name().unwrap_or("a test"), lack.name());
    let _ = std::io::stderr().write_all(line.as_bytes());
    if let Some(path) = std::env::var_os("GSCREAM_SKIPS") {
        let file = std::fs::File::options().append(true).create(true).open(path);
        // One write: lines of tests that run beside one another are not mixed.
        file.and_then(|mut file| file.write_all(line.as_bytes()))
            .expect("the file that GSCREAM_SKIPS names is writable");
    }
    let [ci, may_lack] = ["CI", "GSCREAM_MAY_LACK"].map(|name| std::env::var(name).unwrap_or_default());
    assert!(
        is_allowed(lack, &ci, &may_lack),
        "with CI=true every test must run: {why}. GSCREAM_MAY_LACK={} allows it",
        lack.name()
    );
}

/// Whether a test may be skipped for it, where the environment has these two values.
pub fn is_allowed(lack: Lack, ci: &str, may_lack: &str) -> bool {
    ci != "true" || may_lack.split(',').any(|name| name == lack.name())
}
