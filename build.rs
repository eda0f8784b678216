//! Compiles every `glsl/**/*.comp` to SPIR-V and writes one typed Rust module per kernel.
//!
//! GLSL declares a kernel's interface, once: binding numbers, element types, access, push constants, specialisation
//! constants and the group size are read from the module by reflection; comments behind a declaration become its docs.
//!
//! A line `// variant NAME: DEFINE ...` compiles the file once more as `STEM_NAME` with these macros defined (a
//! specialisation constant does not remove a binding, an `#ifdef` does). `ROOM/cpu/STEM.comp` is the form for CPU drivers of
//! `ROOM/STEM.comp`. All of them are one module with one twin. A binding that not every variant has is an `Option`: those
//! that are given say which variant runs. Where that leaves several, `Kernel` is an enum that says the rest: `Gpu` or `Cpu`
//! for the form, and the macro that tells a variant from the first one with the same bindings (`Plain`).
//!
//! A line `// narrow subgroups` gives a kernel the least subgroups that its device has: `gpu::kernel::Interface::narrow`.

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
    let mut files: Vec<PathBuf> = walkdir::WalkDir::new("glsl")
        .into_iter()
        .map(|entry| entry.map(walkdir::DirEntry::into_path))
        .collect::<Result<_, _>>()?;
    files.retain(|path| path.extension().is_some_and(|e| e == "comp"));
    // A form for CPU drivers joins its kernel's module.
    let for_cpus = |path: &Path| path.parent().is_some_and(|folder| folder.ends_with("cpu"));
    files.sort_by_key(|path| (for_cpus(path), path.clone()));
    let compiler = shaderc::Compiler::new()?;
    let mut kernels: BTreeMap<(Vec<String>, String), Kernel> = BTreeMap::new();
    for path in &files {
        check_mirror(path)?;
        let source = fs::read_to_string(path).with_context(|| format!("{} cannot be read", path.display()))?;
        let folder = path.parent().and_then(|p| p.strip_prefix("glsl").ok()).context("a kernel outside glsl/")?;
        let stem = path.file_stem().and_then(|s| s.to_str()).context("a kernel's name is not UTF-8")?;
        let folders: Vec<String> = folder.iter().map(|f| f.to_string_lossy().into_owned()).collect();
        let room = (folders[..folders.len() - usize::from(for_cpus(path))].to_vec(), stem.to_owned());
        let joins = for_cpus(path) && kernels.contains_key(&room);
        let kernel = kernels.entry(if joins { room } else { (folders, stem.to_owned()) }).or_default();
        kernel.sources.push(path.display().to_string());
        for (suffix, defines) in variants(&source) {
            let stem = if suffix.is_empty() { stem.to_owned() } else { format!("{stem}_{suffix}") };
            let name = folder.join(&stem).to_string_lossy().replace('\\', "/");
            // -O strips names and unused bindings: reflect the unoptimised module, ship the optimised one.
            let plain = compile(&compiler, path, &source, &defines, shaderc::OptimizationLevel::Zero)?;
            let slim = compile(&compiler, path, &source, &defines, shaderc::OptimizationLevel::Performance)?;
            let spirv = out.join(format!("{}.spv", name.replace('/', ".")));
            fs::write(&spirv, slim.as_binary_u8())?;
            let interface = reflect(plain.as_binary(), &source).with_context(|| format!("in {}", path.display()))?;
            kernel.variants.push(Variant { name, cpu: joins, defines, interface, spirv });
        }
    }
    let mut tree = Tree::default();
    for ((folders, stem), kernel) in &kernels {
        let code = kernel.print(stem).with_context(|| format!("in {}", kernel.sources.join(" and ")))?;
        tree.insert(folders, stem.clone(), code);
    }
    let interfaces: Vec<&Interface> = kernels.values().flat_map(|k| &k.variants).map(|v| &v.interface).collect();
    fs::write(out.join("kernels.rs"), format!("{}{}", extremes(&interfaces), tree.print()))?;
    Ok(())
}

/// Lanes of a CPU's vectors, and the workgroups of the kernels' forms for CPUs.
const CPU_LANES: u32 = 8;

/// What the most demanding kernels ask of a device.
fn extremes(all: &[&Interface]) -> String {
    let most = |of: &dyn Fn(&Interface) -> u32| all.iter().map(|i| of(i)).max().unwrap_or(0);
    // Forms for CPUs have a workgroup of one subgroup, and run where it has that width alone.
    let subgroups = all.iter().filter(|i| i.subgroups && i.group[0] > CPU_LANES).map(|i| i.group[0]);
    let constant = |doc: &str, name: &str, value: u32| format!("/// {doc}\npub const {name}: u32 = {value};\n");
    [
        constant("Most storage buffers that a kernel binds.", "MOST_BUFFERS", most(&|i| i.bindings.len() as u32)),
        constant("Most bytes of push constants.", "MOST_PUSH_BYTES", most(&Interface::push_bytes)),
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

#[derive(Clone)]
struct Binding {
    number: u32,
    name: String,
    access: &'static str,
    element: Type,
    doc: String,
}

#[derive(Clone, PartialEq)]
struct Member {
    name: String,
    offset: u32,
    value: Type,
    doc: String,
}

#[derive(Clone, PartialEq)]
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
    narrow: bool,
}

impl Interface {
    fn push_bytes(&self) -> u32 {
        self.push.iter().map(|m| m.offset + m.value.size()).max().unwrap_or(0)
    }
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
    let narrow = source.lines().any(|line| line == "// narrow subgroups");
    constants.sort_by_key(|c| c.id);
    Ok(Interface { group, bindings: found, push, constants, subgroups, narrow })
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

/// One compilation of a kernel.
struct Variant {
    name: String,
    /// Compiled from the form for CPU drivers, of a kernel that has one for GPUs too.
    cpu: bool,
    defines: Vec<String>,
    interface: Interface,
    spirv: PathBuf,
}

/// A kernel: all its variants, the base first.
#[derive(Default)]
struct Kernel {
    sources: Vec<String>,
    variants: Vec<Variant>,
}

/// `NO_SSIM` as `NoSsim`, `RUN=4` as `Run4`.
fn camel(define: &str) -> String {
    let capital = |word: &str| format!("{}{}", &word[..1], word[1..].to_lowercase());
    define.split(['_', '=']).filter(|word| !word.is_empty()).map(capital).collect()
}

impl Kernel {
    /// Every variant's bindings by number; after them those that only the form for CPU drivers has.
    fn bindings(&self) -> Result<Vec<Binding>> {
        let mut all: Vec<(bool, Binding)> = vec![];
        for (variant, b) in self.variants.iter().flat_map(|v| v.interface.bindings.iter().map(move |b| (v, b))) {
            match all.iter_mut().find(|(_, known)| known.name == b.name) {
                None => all.push((variant.cpu, b.clone())),
                Some((_, known)) => {
                    ensure!(known.element.scalar == b.element.scalar, "buffer {} has two types", b.name);
                    if known.access != b.access {
                        known.access = "ReadWrite";
                    }
                }
            }
        }
        ensure!(all.len() <= 32, "{} bindings", all.len());
        all.sort_by_key(|(cpu, b)| (*cpu, b.number));
        Ok(all.into_iter().map(|(_, b)| b).collect())
    }

    /// The longest push constants, with which all others begin.
    fn push(&self) -> Result<&[Member]> {
        let longest = self.variants.iter().map(|v| v.interface.push.as_slice()).max_by_key(|push| push.len());
        let longest = longest.unwrap_or_default();
        for Variant { name, interface, .. } in &self.variants {
            let same = |(a, b): (&Member, &Member)| (&a.name, a.offset, &a.value) == (&b.name, b.offset, &b.value);
            ensure!(interface.push.iter().zip(longest).all(same), "{name}: push constants must begin like the others'");
        }
        Ok(longest)
    }

    /// Every variant's specialisation constants, by number.
    fn constants(&self) -> Result<Vec<Constant>> {
        let mut all: BTreeMap<u32, Constant> = BTreeMap::new();
        for constant in self.variants.iter().flat_map(|v| &v.interface.constants) {
            let known = all.entry(constant.id).or_insert_with(|| constant.clone());
            ensure!(known.name == constant.name, "constant {} has two names", constant.id);
        }
        Ok(all.into_values().collect())
    }

    /// A bit mask per variant: the bindings that it has.
    fn bound(&self, bindings: &[Binding]) -> Vec<u32> {
        let has = |v: &Variant, b: &Binding| v.interface.bindings.iter().any(|own| own.name == b.name);
        let bits = |v| bindings.iter().enumerate().map(|(i, b)| u32::from(has(v, b)) << i).sum();
        self.variants.iter().map(bits).collect()
    }

    /// The `Kernel` value that selects each variant.
    fn choices(&self, bound: &[u32]) -> Result<Vec<String>> {
        let base = if self.variants.iter().any(|v| v.cpu) { "Gpu" } else { "Plain" };
        let mut choices: Vec<String> = vec![];
        for (i, variant) in self.variants.iter().enumerate() {
            let first = (0..i).find(|&j| bound[j] == bound[i] && self.variants[j].cpu == variant.cpu);
            let choice = match first {
                _ if variant.cpu => "Cpu".into(),
                None => base.into(),
                Some(first) => {
                    let own = variant.defines.iter().find(|d| !self.variants[first].defines.contains(d));
                    camel(own.with_context(|| format!("{} is as {}", variant.name, self.variants[first].name))?)
                }
            };
            let taken = choices.iter().zip(bound).any(|(c, b)| (c, b) == (&choice, &bound[i]));
            ensure!(!taken, "nothing tells {} from another variant", variant.name);
            choices.push(choice);
        }
        Ok(choices)
    }

    fn print(&self, stem: &str) -> Result<String> {
        let (bindings, push, constants) = (self.bindings()?, self.push()?, self.constants()?);
        let bound = self.bound(&bindings);
        let choices = self.choices(&bound)?;
        let mut kinds: Vec<&String> = vec![];
        for choice in &choices {
            if !kinds.contains(&choice) {
                kinds.push(choice);
            }
        }
        let optional = |i: usize| bound.iter().any(|bits| bits >> i & 1 == 0);
        let mut w = String::new();
        let mut line = |text: String| {
            w.push_str(&text);
            w.push('\n');
        };
        let doc = |text: &str| if text.is_empty() { String::new() } else { format!("/// {text}\n") };
        let each = |f: &dyn Fn(usize, &Binding) -> String| {
            bindings.iter().enumerate().map(|(i, b)| f(i, b)).collect::<Vec<_>>().join("\n")
        };
        let field = |i: usize, b: &Binding, ty: String| {
            let ty = if optional(i) { format!("Option<{ty}>") } else { ty };
            format!("{}pub {}: {ty},", doc(&b.doc), b.name)
        };
        let mutable = |b: &Binding| if b.access == "Read" { "" } else { "mut " };
        let names: Vec<String> = self.variants.iter().map(|v| format!("`{}`", v.name)).collect();
        line(format!("/// {}, from `{}`.", names.join(", "), self.sources.join("` and `")));
        line(format!("pub mod {stem} {{"));
        line("#[allow(unused_imports)] use crate::gpu::kernel::*;".into());
        line("/// What the kernel binds.\n#[derive(Clone, Copy)]\npub struct Buffers<'a> {".into());
        line(each(&|i, b| field(i, b, format!("&'a crate::gpu::Buffer<{}>", b.element.rust()))));
        line("}".into());
        line("/// The same bindings as host slices: what the CPU twin sees.\npub struct Host<'a> {".into());
        line(each(&|i, b| field(i, b, format!("&'a {}[{}]", mutable(b), b.element.rust()))));
        if kinds.len() > 1 {
            line("/// What runs.\npub kernel: Kernel,".into());
        }
        line("}".into());
        line("/// The same bindings, owned: one test case.\n#[derive(Clone, Default)]\npub struct Arrays {".into());
        line(each(&|i, b| field(i, b, format!("Vec<{}>", b.element.rust()))));
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
            for c in &constants {
                line(format!("{}pub {}: {},", doc(&c.doc), c.name, c.scalar));
            }
            line("}\nimpl Default for Constants { fn default() -> Self { Self {".into());
            for c in &constants {
                line(format!("{}: {},", c.name, c.default));
            }
            line("} } }".into());
        }
        let mut choice = "0";
        if kinds.len() > 1 {
            line("/// The kernel: what its bindings do not tell of a variant.".into());
            line("#[derive(Clone, Copy, Debug, PartialEq, Eq)]\npub enum Kernel {".into());
            kinds.iter().for_each(|kind| line(format!("{kind},")));
            line("}".into());
            if kinds[0] == "Gpu" {
                line(
                    "impl From<crate::gpu::Form> for Kernel { fn from(form: crate::gpu::Form) -> Self { match form {"
                        .into(),
                );
                line("crate::gpu::Form::Gpu => Self::Gpu, crate::gpu::Form::Cpu => Self::Cpu } } }".into());
            }
            choice = "self as u32";
        } else {
            line("/// The kernel.\n#[derive(Clone, Copy, Debug)]\npub struct Kernel;".into());
        }
        line("impl crate::gpu::Kernel for Kernel {".into());
        line("type Buffers<'a> = Buffers<'a>; type Host<'a> = Host<'a>; type Arrays = Arrays; type Push = Push; type Constants = Constants;".into());
        line(format!("const BINDINGS: usize = {};", bindings.len()));
        line("const VARIANTS: &'static [Interface] = &[".into());
        for ((variant, bound), choice) in self.variants.iter().zip(&bound).zip(&choices) {
            let kind = kinds.iter().position(|kind| *kind == choice).unwrap_or(0);
            line(variant.print(&bindings, &constants, *bound, kind));
        }
        line("];".into());
        line(format!("fn choice(self) -> u32 {{ {choice} }}"));
        line(format!(
            "fn slots(buffers: &Buffers<'_>) -> Vec<Option<Slot>> {{ vec![{}] }}",
            each(&|i, b| match optional(i) {
                true => format!("buffers.{}.map(|b| b.slot()),", b.name),
                false => format!("Some(buffers.{}.slot()),", b.name),
            })
        ));
        let pattern = bindings.iter().map(|b| b.name.clone()).collect::<Vec<_>>().join(", ");
        let open = format!("let [{pattern}] = words else {{ wrong_bindings(Self::VARIANTS, {}) }};", bindings.len());
        line(format!(
            "fn host(self, words: &mut [Option<Vec<u32>>]) -> Host<'_> {{ {open} Host {{ {} {} }} }}",
            each(&|i, b| {
                let (of, by) =
                    if b.access == "Read" { ("as_deref", "elements") } else { ("as_deref_mut", "elements_mut") };
                match optional(i) {
                    true => format!("{0}: {0}.{of}().map({by}),", b.name),
                    false => format!("{0}: {by}(bound({0}.{of}(), {0:?})),", b.name),
                }
            }),
            if kinds.len() > 1 { "kernel: self," } else { "" }
        ));
        line(format!(
            "fn words(arrays: Arrays) -> Vec<Option<Vec<u32>>> {{ vec![{}] }}",
            each(&|i, b| match optional(i) {
                true => format!("arrays.{}.as_deref().map(words_of),", b.name),
                false => format!("Some(words_of(&arrays.{})),", b.name),
            })
        ));
        line(format!(
            "fn arrays(words: &[Option<Vec<u32>>]) -> Arrays {{ {open} Arrays {{ {} }} }}",
            each(&|i, b| match optional(i) {
                true => format!("{0}: {0}.as_deref().map(elements_of),", b.name),
                false => format!("{0}: elements_of(bound({0}.as_deref(), {0:?})),", b.name),
            })
        ));
        line("}\n}".into());
        Ok(w)
    }
}

impl Variant {
    /// The `Interface` as Rust source.
    fn print(&self, all: &[Binding], constants: &[Constant], bound: u32, choice: usize) -> String {
        let Interface { group, bindings, subgroups, narrow, constants: own, .. } = &self.interface;
        let binding = |b: &Binding| {
            let at = all.iter().position(|of_all| of_all.name == b.name).unwrap_or(0);
            let (number, name, access, scalar) = (b.number, &b.name, b.access, b.element.scalar.to_uppercase());
            format!(
                "Binding {{ number: {number}, at: {at}, name: {name:?}, access: Access::{access}, scalar: Scalar::{scalar} }},\n"
            )
        };
        let constant = |c: &Constant| {
            let at = constants.iter().position(|of_all| of_all.id == c.id).unwrap_or(0);
            format!("({}, {at}),", c.id)
        };
        format!(
            "Interface {{ name: {:?}, choice: {choice}, bound: {bound:#b}, group: {group:?}, subgroups: {subgroups}, narrow: {narrow}, \
             bindings: &[{}], constants: &[{}], push_bytes: {}, spirv: include_bytes!({:?}) }},",
            self.name,
            bindings.iter().map(binding).collect::<String>(),
            own.iter().map(constant).collect::<String>(),
            self.interface.push_bytes(),
            self.spirv.display().to_string()
        )
    }
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
