//! Links what an installed libshaderc.so lacks.
//!
//! shaderc-sys takes an installed shaderc, found by SHADERC_LIB_DIR, VULKAN_SDK or pkg-config, and builds it from source
//! where there is none. Debian 12's libshaderc.so uses glslang and SPIRV-Tools without naming them, so that nothing links
//! with it alone. Their archives are linked as a whole: the linker sees them before the library that needs them.

use std::path::{Path, PathBuf};
use std::{env, fs, process};

/// Without these nothing links: packages glslang-dev and spirv-tools.
const NEEDED: [&str; 3] = ["glslang", "SPIRV-Tools-opt", "SPIRV-Tools"];
/// Parts of glslang that some versions keep in archives of their own.
const PARTS: [&str; 6] =
    ["MachineIndependent", "GenericCodeGen", "OSDependent", "OGLCompiler", "SPIRV", "glslang-default-resource-limits"];

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    for name in ["SHADERC_LIB_DIR", "VULKAN_SDK"] {
        println!("cargo:rerun-if-env-changed={name}");
        if env::var_os(name).is_some() {
            return;
        }
    }
    if env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os != "linux") {
        return;
    }
    let folder = folder();
    let library = folder.join("libshaderc.so");
    println!("cargo:rerun-if-changed={}", library.display());
    if !lacks_glslang(&library) {
        return;
    }
    let archive = |name: &str| folder.join(format!("lib{name}.a")).exists();
    if let Some(name) = NEEDED.iter().find(|name| !archive(name)) {
        eprintln!(
            "{}: needs lib{name}.a, which is not there: install glslang-dev and spirv-tools, or remove libshaderc-dev to \
             build shaderc from source",
            library.display()
        );
        process::exit(1);
    }
    println!("cargo:rustc-link-search=native={}", folder.display());
    for name in NEEDED.iter().chain(PARTS.iter().filter(|name| archive(name))) {
        println!("cargo:rustc-link-lib=static:-bundle,+whole-archive={name}");
    }
}

/// Where shaderc-sys looks.
fn folder() -> PathBuf {
    let found = pkg_config::Config::new().cargo_metadata(false).probe("shaderc");
    if let Some(folder) = found.ok().and_then(|library| library.link_paths.into_iter().next()) {
        return folder;
    }
    let arch = env::var("CARGO_CFG_TARGET_ARCH").unwrap_or_default();
    Path::new("/usr/lib").join(format!("{arch}-linux-gnu"))
}

/// Whether the library uses glslang's parser and does not name the library that has it.
fn lacks_glslang(library: &Path) -> bool {
    let Ok(bytes) = fs::read(library) else { return false };
    let has = |text: &[u8]| bytes.windows(text.len()).any(|window| window == text);
    has(b"_ZN7glslang7TShader5parse") && !has(b"libglslang.so")
}
