//! Compiles every `glsl/**/*.comp` to SPIR-V and writes one typed Rust module per kernel.
//!
//! GLSL declares a kernel's interface, once: binding numbers, element types, access, push constants, specialisation
//! constants and the group size are read from the module by reflection; comments behind a declaration become its docs.
//!
//! A line `// variant NAME: DEFINE ...` compiles the file once more as `STEM_NAME` with these macros defined, for an
//! interface that differs (a specialisation constant does not remove a binding, an `#ifdef` does).

use std::collections::{BTreeMap, HashMap};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::{env, fs};

use anyhow::{Context, Result, bail, ensure};
use rspirv::dr::{Module, Operand};
use rspirv::spirv::{Decoration, ExecutionMode, Op, StorageClass, Word};

fn main() -> Result<()> {
    println!("cargo:rerun-if-changed=glsl");
    println!("cargo:rerun-if-changed=build.rs");
    let out = PathBuf::from(env::var("OUT_DIR")?);
    let mut tree = Tree::default();
    let mut interfaces = vec![];
    let mut files: Vec<PathBuf> = walkdir::WalkDir::new("glsl")
        .into_iter()
        .map(|entry| entry.map(walkdir::DirEntry::into_path))
        .collect::<Result<_, _>>()?;
    files.retain(|path| path.extension().is_some_and(|e| e == "comp"));
    files.sort();
    let compiler = shaderc::Compiler::new()?;
    for path in &files {
        check_mirror(path)?;
        let source = fs::read_to_string(path).with_context(|| format!("{} cannot be read", path.display()))?;
        for (suffix, defines) in variants(&source) {
            let folder = path.parent().and_then(|p| p.strip_prefix("glsl").ok()).context("a kernel outside glsl/")?;
            let stem = path.file_stem().and_then(|s| s.to_str()).context("a kernel's name is not UTF-8")?;
            let stem = if suffix.is_empty() { stem.to_owned() } else { format!("{stem}_{suffix}") };
            let name = folder.join(&stem).to_string_lossy().replace('\\', "/");
            // -O strips names and unused bindings: reflect the unoptimised module, ship the optimised one.
            let plain = compile(&compiler, path, &source, &defines, shaderc::OptimizationLevel::Zero)?;
            let slim = compile(&compiler, path, &source, &defines, shaderc::OptimizationLevel::Performance)?;
            let spirv = out.join(format!("{}.spv", name.replace('/', ".")));
            fs::write(&spirv, slim.as_binary_u8())?;
            let interface = reflect(plain.as_binary(), &source).with_context(|| format!("in {}", path.display()))?;
            let folders: Vec<String> = folder.iter().map(|f| f.to_string_lossy().into_owned()).collect();
            tree.insert(&folders, stem, rust_module(&name, path, &interface, &spirv));
            interfaces.push(interface);
        }
    }
    fs::write(out.join("kernels.rs"), format!("{}{}", extremes(&interfaces), tree.print()))?;
    Ok(())
}

/// Lanes of a CPU's vectors, and the workgroups of the kernels' forms for CPUs.
const CPU_LANES: u32 = 8;

/// What the most demanding kernels ask of a device.
fn extremes(all: &[Interface]) -> String {
    let most = |of: &dyn Fn(&Interface) -> u32| all.iter().map(of).max().unwrap_or(0);
    let push = |i: &Interface| i.push.iter().map(|m| m.offset + m.value.size()).max().unwrap_or(0);
    // Forms for CPUs have a workgroup of one subgroup, and run where it has that width alone.
    let subgroups = all.iter().filter(|i| i.subgroups && i.group[0] > CPU_LANES).map(|i| i.group[0]);
    let constant = |doc: &str, name: &str, value: u32| format!("/// {doc}\npub const {name}: u32 = {value};\n");
    [
        constant("Most storage buffers that a kernel binds.", "MOST_BUFFERS", most(&|i| i.bindings.len() as u32)),
        constant("Most bytes of push constants.", "MOST_PUSH_BYTES", most(&push)),
        constant("Most threads of a workgroup.", "MOST_THREADS", most(&|i| i.group.iter().product())),
        constant(
            "Most threads of a workgroup with subgroup operations: its subgroups are asked to be full and of one size.",
            "MOST_FULL_THREADS",
            most(&|i| if i.subgroups { i.group.iter().product() } else { 0 }),
        ),
        constant(
            "Threads in x of the smallest workgroup with subgroup operations: a full subgroup holds no more.",
            "MOST_SUBGROUP_THREADS",
            subgroups.min().unwrap_or(0),
        ),
    ]
    .concat()
}

/// `glsl/` mirrors `src/` (checked when anything in `glsl/` changes): kernel `a/b_backward.comp` and its form for CPU
/// drivers, `a/cpu/b_backward.comp`, belong to `src/a/b_backward.rs` or `src/a/b.rs` or the room `src/a/b/`.
fn check_mirror(path: &Path) -> Result<()> {
    let relative = path.strip_prefix("glsl")?;
    let room = relative.parent().unwrap_or(Path::new(""));
    let room = if room.ends_with("cpu") { room.parent().unwrap_or(room) } else { room };
    let folder = Path::new("src").join(room);
    let stem = relative.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut owner = stem.as_str();
    loop {
        if folder.join(format!("{owner}.rs")).exists() || folder.join(owner).join("mod.rs").exists() {
            return Ok(());
        }
        match owner.rfind('_') {
            Some(at) => owner = &owner[..at],
            None => bail!("{}: no owner in {}: expected {stem}.rs", path.display(), folder.display()),
        }
    }
}

/// The base variant (no suffix) and one for each `// variant NAME: DEFINES` line.
fn variants(source: &str) -> Vec<(String, Vec<String>)> {
    let mut all = vec![(String::new(), vec![])];
    for line in source.lines() {
        if let Some((name, defines)) = line.strip_prefix("// variant ").and_then(|rest| rest.split_once(':')) {
            all.push((name.trim().to_owned(), defines.split_whitespace().map(str::to_owned).collect()));
        }
    }
    all
}

fn compile(
    compiler: &shaderc::Compiler,
    path: &Path,
    source: &str,
    defines: &[String],
    level: shaderc::OptimizationLevel,
) -> Result<shaderc::CompilationArtifact> {
    let mut options = shaderc::CompileOptions::new()?;
    options.set_target_env(shaderc::TargetEnv::Vulkan, shaderc::EnvVersion::Vulkan1_3 as u32);
    // Mesa 22.3's lavapipe refuses some SPIR-V 1.5 modules that it accepts as SPIR-V 1.3.
    options.set_target_spirv(shaderc::SpirvVersion::V1_3);
    options.set_warnings_as_errors();
    options.set_optimization_level(level);
    for define in defines {
        let (name, value) = define.split_once('=').map_or((define.as_str(), None), |(n, v)| (n, Some(v)));
        options.add_macro_definition(name, value);
    }
    options.set_include_callback(|name, _, _, _| {
        let file = Path::new("glsl/include").join(name);
        match fs::read_to_string(&file) {
            Ok(content) => Ok(shaderc::ResolvedInclude { resolved_name: file.to_string_lossy().into_owned(), content }),
            Err(error) => Err(format!("{}: {error}", file.display())),
        }
    });
    let name = path.to_string_lossy();
    // shaderc's message begins with `FILE:LINE:`, includes under their own name.
    compiler
        .compile_into_spirv(source, shaderc::ShaderKind::Compute, &name, "main", Some(&options))
        .map_err(|error| anyhow::anyhow!("{error}"))
}

/// A scalar or vector of 4-byte components.
#[derive(Clone, PartialEq)]
struct Type {
    scalar: &'static str,
    components: u32,
}

impl Type {
    fn rust(&self) -> String {
        if self.components == 1 { self.scalar.into() } else { format!("[{}; {}]", self.scalar, self.components) }
    }
    fn size(&self) -> u32 {
        4 * self.components
    }
}

struct Binding {
    number: u32,
    name: String,
    access: &'static str,
    element: Type,
    doc: String,
}

struct Member {
    name: String,
    offset: u32,
    value: Type,
    doc: String,
}

struct Constant {
    id: u32,
    name: String,
    scalar: &'static str,
    default: String,
    doc: String,
}

struct Interface {
    group: [u32; 3],
    bindings: Vec<Binding>,
    push: Vec<Member>,
    constants: Vec<Constant>,
    subgroups: bool,
}

fn word(operand: &Operand) -> Word {
    match operand {
        Operand::IdRef(w) | Operand::LiteralBit32(w) => *w,
        _ => 0,
    }
}

fn reflect(words: &[u32], source: &str) -> Result<Interface> {
    let module: Module = rspirv::dr::load_words(words).map_err(|e| anyhow::anyhow!("SPIR-V does not parse: {e:?}"))?;
    let mut names = HashMap::new();
    let mut members = HashMap::new();
    for i in &module.debug_names {
        match (&i.class.opcode, i.operands.as_slice()) {
            (Op::Name, [Operand::IdRef(id), Operand::LiteralString(s)]) => drop(names.insert(*id, s.clone())),
            (Op::MemberName, [Operand::IdRef(id), m, Operand::LiteralString(s)]) => {
                drop(members.insert((*id, word(m)), s.clone()))
            }
            _ => {}
        }
    }
    let (mut bindings, mut strides, mut spec, mut offsets, mut access) =
        (HashMap::new(), HashMap::new(), HashMap::new(), HashMap::new(), HashMap::new());
    for i in &module.annotations {
        match (&i.class.opcode, i.operands.as_slice()) {
            (Op::Decorate, [Operand::IdRef(id), Operand::Decoration(d), value @ ..]) => {
                let value = value.first().map_or(0, word);
                match d {
                    Decoration::Binding => drop(bindings.insert(*id, value)),
                    Decoration::ArrayStride => drop(strides.insert(*id, value)),
                    Decoration::SpecId => drop(spec.insert(*id, value)),
                    _ => {}
                }
            }
            (Op::MemberDecorate, [Operand::IdRef(id), m, Operand::Decoration(d), value @ ..]) => match d {
                Decoration::Offset => drop(offsets.insert((*id, word(m)), value.first().map_or(0, word))),
                Decoration::NonWritable => drop(access.insert(*id, "Read")),
                Decoration::NonReadable => drop(access.insert(*id, "Write")),
                _ => {}
            },
            _ => {}
        }
    }
    let mut types = HashMap::new();
    let mut blocks = HashMap::new();
    let mut pointers = HashMap::new();
    let mut constants = vec![];
    let (mut found, mut push) = (vec![], vec![]);
    for i in &module.types_global_values {
        let id = i.result_id.unwrap_or(0);
        let operands = &i.operands;
        match i.class.opcode {
            Op::TypeInt => {
                let scalar = if word(&operands[1]) == 1 { "i32" } else { "u32" };
                types.insert(id, Type { scalar, components: 1 });
            }
            Op::TypeFloat => drop(types.insert(id, Type { scalar: "f32", components: 1 })),
            Op::TypeVector => {
                if let Some(scalar) = types.get(&word(&operands[0])).map(|t| t.scalar) {
                    types.insert(id, Type { scalar, components: word(&operands[1]) });
                }
            }
            Op::TypeRuntimeArray => drop(blocks.insert(id, vec![word(&operands[0])])),
            Op::TypeStruct => drop(blocks.insert(id, operands.iter().map(word).collect())),
            Op::TypePointer => drop(pointers.insert(id, word(&operands[1]))),
            Op::SpecConstant => {
                let Some(&number) = spec.get(&id) else { continue };
                let ty = i.result_type.and_then(|t| types.get(&t)).context("a constant of unknown type")?;
                let name = names.get(&id).cloned().unwrap_or_default();
                let bits = word(&operands[0]);
                let default = match ty.scalar {
                    "f32" => format!("f32::from_bits({bits})"),
                    "i32" => format!("{}", bits as i32),
                    _ => format!("{bits}"),
                };
                let doc = comment(source, &format!("const {} {name}", glsl(ty)));
                constants.push(Constant { id: number, name: name.to_lowercase(), scalar: ty.scalar, default, doc });
            }
            Op::Variable => {
                let class = match operands[0] {
                    Operand::StorageClass(class) => class,
                    _ => continue,
                };
                let block = pointers[&i.result_type.unwrap_or(0)];
                match class {
                    StorageClass::StorageBuffer => {
                        let array = blocks[&block][0];
                        let name = members[&(block, 0)].clone();
                        ensure!(blocks.contains_key(&array), "buffer {name} is not one unsized array");
                        let element = types.get(&blocks[&array][0]).cloned();
                        let element = element.with_context(|| format!("buffer {name}: elements must be vectors"))?;
                        ensure!(strides[&array] == element.size(), "buffer {name}: declare its block `scalar`");
                        let access = access.get(&block).copied().unwrap_or("ReadWrite");
                        let doc = comment(source, &format!(" {name}[]"));
                        found.push(Binding { number: bindings[&id], name, access, element, doc });
                    }
                    StorageClass::PushConstant => {
                        for (m, ty) in blocks[&block].iter().enumerate() {
                            let key = (block, m as u32);
                            let name = members[&key].clone();
                            let value = types.get(ty).cloned();
                            let value = value.with_context(|| format!("push constant {name}: must be a vector"))?;
                            let doc = comment(source, &format!("{} {name};", glsl(&value)));
                            push.push(Member { name, offset: offsets[&key], value, doc });
                        }
                    }
                    _ => {}
                }
            }
            _ => {}
        }
    }
    found.sort_by_key(|b| b.number);
    let mut group = [0; 3];
    for i in &module.execution_modes {
        if let [_, Operand::ExecutionMode(ExecutionMode::LocalSize), x, y, z] = i.operands.as_slice() {
            group = [word(x), word(y), word(z)];
        }
    }
    ensure!(group[0] > 0, "no local_size");
    let subgroups = module.capabilities.iter().any(|c| format!("{:?}", c.operands).contains("GroupNonUniform"));
    constants.sort_by_key(|c| c.id);
    Ok(Interface { group, bindings: found, push, constants, subgroups })
}

fn glsl(ty: &Type) -> String {
    let (scalar, vector) = match ty.scalar {
        "f32" => ("float", "vec"),
        "i32" => ("int", "ivec"),
        _ => ("uint", "uvec"),
    };
    if ty.components == 1 { scalar.into() } else { format!("{vector}{}", ty.components) }
}

/// The comment behind the first declaration containing `needle`.
fn comment(source: &str, needle: &str) -> String {
    source
        .lines()
        .find(|line| line.contains(needle))
        .and_then(|line| line.split_once("//"))
        .map_or(String::new(), |(_, text)| text.trim().replace('[', "\\[").replace(']', "\\]"))
}

fn rust_module(name: &str, path: &Path, interface: &Interface, spirv: &Path) -> String {
    let Interface { group, bindings, push, constants, subgroups } = interface;
    let mut w = String::new();
    let mut line = |text: String| {
        w.push_str(&text);
        w.push('\n');
    };
    let doc = |text: &str| if text.is_empty() { String::new() } else { format!("/// {text}\n") };
    let each = |f: &dyn Fn(&Binding) -> String| bindings.iter().map(f).collect::<Vec<_>>().join("\n");
    let stem = name.rsplit('/').next().unwrap_or(name);
    line(format!("/// `{name}`, from `{}`.", path.display()));
    line(format!("pub mod {stem} {{"));
    line("#[allow(unused_imports)] use crate::gpu::kernel::*;".into());
    line("/// What the kernel binds.\n#[derive(Clone, Copy)]\npub struct Buffers<'a> {".into());
    line(each(&|b| format!("{}pub {}: &'a crate::gpu::Buffer<{}>,", doc(&b.doc), b.name, b.element.rust())));
    line("}".into());
    line("/// The same bindings as host slices: what the CPU twin sees.\npub struct Host<'a> {".into());
    line(each(&|b| {
        let mutable = if b.access == "Read" { "" } else { "mut " };
        format!("{}pub {}: &'a {mutable}[{}],", doc(&b.doc), b.name, b.element.rust())
    }));
    line("}".into());
    line("/// The same bindings, owned: one test case.\n#[derive(Clone, Default)]\npub struct Arrays {".into());
    line(each(&|b| format!("{}pub {}: Vec<{}>,", doc(&b.doc), b.name, b.element.rust())));
    line("}".into());
    if push.is_empty() {
        line("/// No push constants.\npub type Push = ();".into());
    } else {
        line("/// Push constants.\n#[repr(C)]\n#[derive(Clone, Copy, Debug, Default, bytemuck::Pod, bytemuck::Zeroable)]\npub struct Push {".into());
        for m in push {
            line(format!("{}pub {}: {},", doc(&m.doc), m.name, m.value.rust()));
        }
        line("}".into());
        let size = push.iter().map(|m| m.offset + m.value.size()).max().unwrap_or(0);
        line(format!("const _: () = assert!(size_of::<Push>() == {size} && {size} <= 128);"));
        for m in push {
            line(format!("const _: () = assert!(std::mem::offset_of!(Push, {}) == {});", m.name, m.offset));
        }
    }
    if constants.is_empty() {
        line("/// No specialisation constants.\npub type Constants = ();".into());
    } else {
        line("/// Specialisation constants.\n#[repr(C)]\n#[derive(Clone, Copy, Debug, bytemuck::Pod, bytemuck::Zeroable)]\npub struct Constants {".into());
        for c in constants {
            line(format!("{}pub {}: {},", doc(&c.doc), c.name, c.scalar));
        }
        line("}\nimpl Default for Constants { fn default() -> Self { Self {".into());
        for c in constants {
            line(format!("{}: {},", c.name, c.default));
        }
        line("} } }".into());
    }
    line("/// The kernel.\n#[derive(Clone, Copy, Debug)]\npub struct Kernel;".into());
    line("impl crate::gpu::Kernel for Kernel {".into());
    line("type Buffers<'a> = Buffers<'a>; type Host<'a> = Host<'a>; type Arrays = Arrays; type Push = Push; type Constants = Constants;".into());
    line(format!("const NAME: &'static str = {name:?};"));
    line(format!("const GROUP: [u32; 3] = {group:?};"));
    line(format!("const SUBGROUPS: bool = {subgroups};"));
    line(format!(
        "const BINDINGS: &'static [Binding] = &[{}];",
        each(&|b| format!(
            "Binding {{ number: {}, name: {:?}, access: Access::{}, scalar: Scalar::{}, components: {} }},",
            b.number,
            b.name,
            b.access,
            b.element.scalar.to_uppercase(),
            b.element.components
        ))
    ));
    line(format!(
        "const CONSTANTS: &'static [u32] = &[{}];",
        constants.iter().map(|c| format!("{},", c.id)).collect::<String>()
    ));
    line(format!("const SPIRV: &'static [u8] = include_bytes!({:?});", spirv.display().to_string()));
    line(format!(
        "fn slots(buffers: &Buffers<'_>) -> Vec<Slot> {{ vec![{}] }}",
        each(&|b| format!("buffers.{}.slot(),", b.name))
    ));
    let pattern = bindings.iter().map(|b| b.name.clone()).collect::<Vec<_>>().join(", ");
    line(format!(
        "fn host(words: &mut [Vec<u32>]) -> Host<'_> {{ let [{pattern}] = words else {{ wrong_bindings(Self::NAME, {}) }}; Host {{ {} }} }}",
        bindings.len(),
        each(&|b| if b.access == "Read" {
            format!("{0}: elements({0}),", b.name)
        } else {
            format!("{0}: elements_mut({0}),", b.name)
        })
    ));
    line(format!(
        "fn words(arrays: Arrays) -> Vec<Vec<u32>> {{ vec![{}] }}",
        each(&|b| format!("words_of(&arrays.{}),", b.name))
    ));
    line(format!(
        "fn arrays(words: &[Vec<u32>]) -> Arrays {{ let [{pattern}] = words else {{ wrong_bindings(Self::NAME, {}) }}; Arrays {{ {} }} }}",
        bindings.len(),
        each(&|b| format!("{0}: elements_of({0}),", b.name))
    ));
    line("}\n}".into());
    w
}

/// Modules nested as the folders are.
#[derive(Default)]
struct Tree {
    folders: BTreeMap<String, Tree>,
    kernels: BTreeMap<String, String>,
}

impl Tree {
    fn insert(&mut self, folders: &[String], stem: String, code: String) {
        match folders {
            [] => drop(self.kernels.insert(stem, code)),
            [first, rest @ ..] => self.folders.entry(first.clone()).or_default().insert(rest, stem, code),
        }
    }
    fn print(&self) -> String {
        let mut text = String::new();
        for (name, tree) in &self.folders {
            let _ = write!(text, "/// Kernels of `glsl/{name}/`.\npub mod {name} {{\n{}}}\n", tree.print());
        }
        text.extend(self.kernels.values().map(String::as_str));
        text
    }
}
