//! A SPIR-V module as a list of scalar instructions on an invocation's registers.
//!
//! Values are laid flat: a vector, a matrix or an array is as many words as it has components, and every instruction works on
//! single words. Blocks lie in structured order, a construct's merge block behind its body, so that the place of an
//! instruction says what comes first.

use std::collections::{HashMap, HashSet};

use rspirv::dr::{Block, Instruction, Module, Operand};
use rspirv::spirv::{BuiltIn, Decoration, ExecutionMode, GlslStd450Op, GroupOperation, Op, StorageClass};

use super::code::{Alu, Edge, Group, Ins, Length, Space};
use super::shape::Shape;

/// A module for one set of constants.
pub struct Program {
    pub code: Vec<Ins>,
    pub edges: Vec<Edge>,
    /// Registers as an invocation finds them, constants in place.
    pub registers: Vec<u32>,
    pub shared_words: u32,
    pub private_words: u32,
    pub input_words: u32,
    /// Words that an invocation's own variables begin with.
    pub initial: Vec<(u32, u32)>,
    pub built_ins: Vec<(BuiltIn, u32)>,
    pub group: [u32; 3],
    pub uses_subgroups: bool,
}

enum Type {
    Other,
    Scalar,
    Composite(Vec<u32>),
    /// Elements, how many.
    Sequence(u32, u32),
    Runtime(u32),
    Pointer(u32),
}

/// What may be contracted, chosen at random where `contract` says so.
pub struct Choices<'c> {
    pub contract: Option<&'c mut dyn FnMut() -> bool>,
}

struct Builder<'b> {
    types: HashMap<u32, Type>,
    /// First register and type of a value.
    values: HashMap<u32, (u32, u32)>,
    spaces: HashMap<u32, Space>,
    registers: Vec<u32>,
    code: Vec<Ins>,
    bindings: HashMap<u32, u32>,
    numbers: &'b [u32],
    spec: HashMap<u32, u32>,
    constants: &'b [(u32, u32)],
    precise: HashSet<u32>,
    /// Products of this block: register of the result, registers of the factors.
    products: HashMap<u32, (u32, u32)>,
    choices: Choices<'b>,
    extended: u32,
    shared_words: u32,
    private_words: u32,
    input_words: u32,
    initial: Vec<(u32, u32)>,
    built_ins: Vec<(BuiltIn, u32)>,
    built_in_of: HashMap<u32, BuiltIn>,
    offsets: HashMap<(u32, u32), u32>,
}

/// The word of an operand that is an id or a number.
pub fn id(operand: &Operand) -> u32 {
    match operand {
        Operand::IdRef(w)
        | Operand::LiteralBit32(w)
        | Operand::IdScope(w)
        | Operand::IdMemorySemantics(w)
        | Operand::LiteralExtInstInteger(w) => *w,
        other => panic!("an id or a number instead of {other:?}"),
    }
}

impl Program {
    /// The program of a module whose bindings have these numbers, with constants by id.
    ///
    /// # Panics
    /// On what kernels do not use.
    pub fn new<'b>(module: &Module, numbers: &'b [u32], constants: &'b [(u32, u32)], choices: Choices<'b>) -> Self {
        let mut b = Builder {
            types: HashMap::new(),
            values: HashMap::new(),
            spaces: HashMap::new(),
            registers: vec![],
            code: vec![],
            bindings: HashMap::new(),
            numbers,
            spec: HashMap::new(),
            constants,
            precise: HashSet::new(),
            products: HashMap::new(),
            choices,
            extended: module.ext_inst_imports.first().and_then(|i| i.result_id).unwrap_or(0),
            shared_words: 0,
            private_words: 0,
            input_words: 0,
            initial: vec![],
            built_ins: vec![],
            built_in_of: HashMap::new(),
            offsets: HashMap::new(),
        };
        b.annotations(module);
        module.types_global_values.iter().for_each(|i| b.global(i));
        let mut group = [1; 3];
        for i in &module.execution_modes {
            if let [_, Operand::ExecutionMode(ExecutionMode::LocalSize), x, y, z] = i.operands.as_slice() {
                group = [id(x), id(y), id(z)];
            }
        }
        let [function] = module.functions.as_slice() else { panic!("one function, all others inlined") };
        let edges = b.blocks(&function.blocks);
        let uses_subgroups = b.code.iter().any(|i| matches!(i, Ins::Group { .. }))
            || b.built_ins.iter().any(|(built_in, _)| {
                use BuiltIn::{NumSubgroups, SubgroupId, SubgroupLocalInvocationId, SubgroupSize};
                matches!(built_in, NumSubgroups | SubgroupId | SubgroupLocalInvocationId | SubgroupSize)
            });
        Self {
            code: b.code,
            edges,
            registers: b.registers,
            shared_words: b.shared_words,
            private_words: b.private_words,
            input_words: b.input_words,
            initial: b.initial,
            built_ins: b.built_ins,
            group,
            uses_subgroups,
        }
    }
}

impl Builder<'_> {
    fn annotations(&mut self, module: &Module) {
        for i in &module.annotations {
            match (i.class.opcode, i.operands.as_slice()) {
                (Op::Decorate, [target, Operand::Decoration(decoration), rest @ ..]) => {
                    let target = id(target);
                    match (decoration, rest) {
                        (Decoration::Binding, [number]) => drop(self.bindings.insert(target, id(number))),
                        (Decoration::SpecId, [number]) => drop(self.spec.insert(target, id(number))),
                        (Decoration::NoContraction, _) => drop(self.precise.insert(target)),
                        (Decoration::BuiltIn, [Operand::BuiltIn(built_in)]) => {
                            self.built_in_of.insert(target, *built_in);
                        }
                        _ => {}
                    }
                }
                (Op::MemberDecorate, [target, member, Operand::Decoration(Decoration::Offset), bytes]) => {
                    self.offsets.insert((id(target), id(member)), id(bytes) / 4);
                }
                _ => {}
            }
        }
    }

    /// Words of a type's value.
    fn words(&self, ty: u32) -> u32 {
        match &self.types[&ty] {
            Type::Other => 0,
            Type::Scalar | Type::Pointer(_) => 1,
            Type::Composite(members) => members.iter().map(|m| self.words(*m)).sum(),
            Type::Sequence(element, count) => self.words(*element) * count,
            Type::Runtime(element) => self.words(*element),
        }
    }

    fn temporary(&mut self, words: u32) -> u32 {
        let at = self.registers.len() as u32;
        self.registers.resize(self.registers.len() + words as usize, 0xdead_beef);
        at
    }

    fn define(&mut self, i: &Instruction) -> u32 {
        let ty = i.result_type.expect("a value has a type");
        let at = self.temporary(self.words(ty));
        self.values.insert(i.result_id.expect("a value has an id"), (at, ty));
        at
    }

    /// First register of a value.
    fn at(&self, operand: &Operand) -> u32 {
        self.values[&id(operand)].0
    }

    fn type_of(&self, operand: &Operand) -> u32 {
        self.values[&id(operand)].1
    }

    fn global(&mut self, i: &Instruction) {
        let known = i.result_id.unwrap_or(0);
        let ids = || i.operands.iter().map(id).collect::<Vec<u32>>();
        match i.class.opcode {
            Op::TypeVoid | Op::TypeFunction => drop(self.types.insert(known, Type::Other)),
            Op::TypeBool | Op::TypeInt | Op::TypeFloat => drop(self.types.insert(known, Type::Scalar)),
            Op::TypeVector | Op::TypeMatrix => {
                let [element, count] = ids()[..] else { panic!("{i:?}") };
                self.types.insert(known, Type::Sequence(element, count));
            }
            Op::TypeArray => {
                let count = self.registers[self.at(&i.operands[1]) as usize];
                self.types.insert(known, Type::Sequence(id(&i.operands[0]), count));
            }
            Op::TypeRuntimeArray => drop(self.types.insert(known, Type::Runtime(id(&i.operands[0])))),
            Op::TypeStruct => drop(self.types.insert(known, Type::Composite(ids()))),
            Op::TypePointer => drop(self.types.insert(known, Type::Pointer(id(&i.operands[1])))),
            Op::Constant | Op::SpecConstant => {
                let at = self.define(i) as usize;
                let given = self.spec.get(&known).and_then(|number| self.constants.iter().find(|(n, _)| n == number));
                self.registers[at] = given.map_or_else(|| id(&i.operands[0]), |(_, word)| *word);
            }
            Op::ConstantTrue | Op::ConstantFalse | Op::SpecConstantTrue | Op::SpecConstantFalse => {
                let at = self.define(i) as usize;
                self.registers[at] = u32::from(matches!(i.class.opcode, Op::ConstantTrue | Op::SpecConstantTrue));
            }
            Op::ConstantComposite | Op::SpecConstantComposite => {
                let at = self.define(i);
                self.gather(at, &i.operands, true);
            }
            Op::ConstantNull => {
                let (at, words) = (self.define(i) as usize, self.words(i.result_type.unwrap_or(0)) as usize);
                self.registers[at..at + words].fill(0);
            }
            Op::Undef => drop(self.define(i)),
            Op::SpecConstantOp => {
                let at = self.define(i) as usize;
                let op = match &i.operands[0] {
                    Operand::LiteralSpecConstantOpInteger(op) => *op,
                    other => panic!("{other:?}"),
                };
                let args: Vec<u32> = i.operands[1..].iter().map(|o| self.registers[self.at(o) as usize]).collect();
                if op == Op::Select {
                    let [which, x, y] = args[..] else { panic!("{i:?}") };
                    self.registers[at] = if which == 0 { y } else { x };
                    return;
                }
                let [x, y] = args[..] else { panic!("{i:?}") };
                self.registers[at] = match op {
                    Op::IAdd => x.wrapping_add(y),
                    Op::ISub => x.wrapping_sub(y),
                    Op::IMul => x.wrapping_mul(y),
                    Op::UDiv => x / y,
                    Op::UMod => x % y,
                    Op::ShiftLeftLogical => x << y,
                    Op::ShiftRightLogical => x >> y,
                    Op::BitwiseAnd => x & y,
                    Op::UGreaterThan => u32::from(x > y),
                    Op::ULessThan => u32::from(x < y),
                    Op::IEqual => u32::from(x == y),
                    Op::INotEqual => u32::from(x != y),
                    other => panic!("{other:?} of constants"),
                };
            }
            Op::Variable => self.variable(i),
            other => panic!("{other:?} is not known"),
        }
    }

    fn variable(&mut self, i: &Instruction) {
        let at = self.define(i) as usize;
        let known = i.result_id.expect("a variable has an id");
        let Some(Type::Pointer(pointee)) = i.result_type.and_then(|ty| self.types.get(&ty)) else { panic!("{i:?}") };
        let words = self.words(*pointee);
        let Operand::StorageClass(class) = i.operands[0] else { panic!("{i:?}") };
        let take = |end: &mut u32| {
            let begin = *end;
            *end += words;
            begin
        };
        let (space, base) = match class {
            StorageClass::StorageBuffer => {
                let number = self.bindings[&known];
                let place = self.numbers.iter().position(|n| *n == number).expect("a binding of the kernel's");
                (Space::Buffer(place), 0)
            }
            StorageClass::Workgroup => (Space::Shared, take(&mut self.shared_words)),
            StorageClass::Function | StorageClass::Private => (Space::Private, take(&mut self.private_words)),
            StorageClass::PushConstant => (Space::Push, 0),
            StorageClass::Input => {
                let at = take(&mut self.input_words);
                self.built_ins.push((self.built_in_of[&known], at));
                (Space::Input, at)
            }
            other => panic!("{other:?} variables"),
        };
        if let Some(initial) = i.operands.get(1) {
            let from = self.at(initial);
            self.initial.extend((0..words).map(|w| (base + w, self.registers[(from + w) as usize])));
        }
        self.registers[at] = base;
        self.spaces.insert(known, space);
    }

    /// Values one behind the other; known now or when the program runs.
    fn gather(&mut self, to: u32, parts: &[Operand], known: bool) {
        let mut at = to;
        for part in parts {
            let (from, ty) = self.values[&id(part)];
            for word in 0..self.words(ty) {
                if known {
                    self.registers[at as usize] = self.registers[(from + word) as usize];
                } else {
                    self.alu(Alu::Copy, at, [from + word, 0, 0]);
                }
                at += 1;
            }
        }
    }

    fn alu(&mut self, op: Alu, to: u32, args: [u32; 3]) {
        self.code.push(Ins::Alu { op, to, args });
    }

    /// Emits all blocks in structured order and returns the edges between them.
    fn blocks(&mut self, blocks: &[Block]) -> Vec<Edge> {
        let shape = Shape::of(blocks);
        for block in blocks {
            for i in &block.instructions {
                match i.class.opcode {
                    Op::Variable => self.variable(i),
                    // Phis are read before their block is emitted.
                    Op::Phi => drop(self.define(i)),
                    _ => {}
                }
            }
        }
        let mut begins = vec![usize::MAX; blocks.len()];
        let mut wanted: Vec<(usize, usize)> = vec![];
        for &at in &shape.order {
            begins[at] = self.code.len();
            self.products.clear();
            for i in &blocks[at].instructions {
                let mut edge = |target: &Operand| {
                    wanted.push((at, shape.index[&id(target)]));
                    wanted.len() - 1
                };
                match i.class.opcode {
                    Op::Phi | Op::Variable | Op::SelectionMerge | Op::LoopMerge | Op::Line | Op::NoLine | Op::Nop => {}
                    Op::Branch => {
                        let edge = edge(&i.operands[0]);
                        self.code.push(Ins::Jump(edge));
                    }
                    Op::BranchConditional => {
                        let edges = [edge(&i.operands[1]), edge(&i.operands[2])];
                        self.code.push(Ins::Branch { condition: self.at(&i.operands[0]), edges });
                    }
                    Op::Switch => {
                        let default = edge(&i.operands[1]);
                        let cases = i.operands[2..].chunks_exact(2).map(|c| (id(&c[0]), edge(&c[1]))).collect();
                        self.code.push(Ins::Switch { selector: self.at(&i.operands[0]), default, cases });
                    }
                    Op::Return => self.code.push(Ins::Return),
                    Op::Unreachable => self.code.push(Ins::Jump(usize::MAX)),
                    _ => self.instruction(i),
                }
            }
        }
        let edge = |&(from, to): &(usize, usize)| {
            let label = blocks[from].label.as_ref().and_then(|l| l.result_id);
            let mut moves = vec![];
            for phi in blocks[to].instructions.iter().filter(|i| i.class.opcode == Op::Phi) {
                let (at, ty) = self.values[&phi.result_id.expect("a phi has an id")];
                let source = phi.operands.chunks_exact(2).find(|pair| Some(id(&pair[1])) == label);
                let (source, _) = self.values[&id(&source.expect("a value for every way")[0])];
                moves.extend((0..self.words(ty)).map(|w| (source + w, at + w)));
            }
            let (around, inside) = (&shape.loops[from], &shape.loops[to]);
            let again = shape.is_header(to) && around.contains(&to);
            let keep = around.iter().zip(inside).take_while(|(a, b)| a == b).count();
            let enter = inside[keep..].iter().map(|&header| begins[header] as u32).collect();
            Edge { target: begins[to], moves, keep, enter, again }
        };
        wanted.iter().map(edge).collect()
    }

    fn pointer(&self, operand: &Operand) -> (Space, u32) {
        (self.spaces[&id(operand)], self.at(operand))
    }

    fn instruction(&mut self, i: &Instruction) {
        let operands = &i.operands;
        match i.class.opcode {
            Op::Load => {
                let to = self.define(i);
                let (space, at) = self.pointer(&operands[0]);
                let words = self.words(i.result_type.expect("typed"));
                self.code.push(Ins::Load { space, to, at, words });
            }
            Op::Store => {
                let (space, at) = self.pointer(&operands[0]);
                let (from, ty) = self.values[&id(&operands[1])];
                self.code.push(Ins::Store { space, from, at, words: self.words(ty) });
            }
            Op::AccessChain | Op::InBoundsAccessChain => self.chain(i),
            Op::CompositeConstruct => {
                let to = self.define(i);
                self.gather(to, operands, false);
            }
            Op::CompositeExtract => {
                let to = self.define(i);
                let (from, _) = self.inside(self.values[&id(&operands[0])], &operands[1..]);
                (0..self.words(i.result_type.expect("typed")))
                    .for_each(|w| self.alu(Alu::Copy, to + w, [from + w, 0, 0]));
            }
            Op::CompositeInsert => {
                let to = self.define(i);
                let ty = i.result_type.expect("typed");
                let (old, part) = (self.at(&operands[1]), self.values[&id(&operands[0])]);
                (0..self.words(ty)).for_each(|w| self.alu(Alu::Copy, to + w, [old + w, 0, 0]));
                let (into, _) = self.inside((to, ty), &operands[2..]);
                (0..self.words(part.1)).for_each(|w| self.alu(Alu::Copy, into + w, [part.0 + w, 0, 0]));
            }
            Op::VectorShuffle => {
                let to = self.define(i);
                let (first, ty) = self.values[&id(&operands[0])];
                let (second, count) = (self.at(&operands[1]), self.words(ty));
                for (w, component) in operands[2..].iter().map(id).enumerate() {
                    let from = if component < count { first + component } else { second + component - count };
                    self.alu(Alu::Copy, to + w as u32, [from, 0, 0]);
                }
            }
            Op::Undef => drop(self.define(i)),
            Op::Select => {
                let to = self.define(i);
                let [c, a, b] = [0, 1, 2].map(|n| self.at(&operands[n]));
                let single = self.words(self.type_of(&operands[0])) == 1;
                for w in 0..self.words(i.result_type.expect("typed")) {
                    self.alu(Alu::Select, to + w, [if single { c } else { c + w }, a + w, b + w]);
                }
            }
            Op::VectorTimesScalar => {
                let to = self.define(i);
                let [vector, scalar] = [0, 1].map(|n| self.at(&operands[n]));
                (0..self.words(i.result_type.expect("typed")))
                    .for_each(|w| self.product(i, to + w, vector + w, scalar));
            }
            Op::Dot => {
                let to = self.define(i);
                let [a, b] = [0, 1].map(|n| self.at(&operands[n]));
                let words = self.words(self.type_of(&operands[0]));
                self.dot(i, to, &(0..words).map(|w| (a + w, b + w)).collect::<Vec<_>>());
            }
            Op::MatrixTimesVector => {
                let to = self.define(i);
                let [matrix, vector] = [0, 1].map(|n| self.at(&operands[n]));
                let (rows, columns) =
                    (self.words(i.result_type.expect("typed")), self.words(self.type_of(&operands[1])));
                for row in 0..rows {
                    let terms: Vec<_> = (0..columns).map(|c| (matrix + c * rows + row, vector + c)).collect();
                    self.dot(i, to + row, &terms);
                }
            }
            Op::VectorTimesMatrix => {
                let to = self.define(i);
                let [vector, matrix] = [0, 1].map(|n| self.at(&operands[n]));
                let (columns, rows) =
                    (self.words(i.result_type.expect("typed")), self.words(self.type_of(&operands[0])));
                for column in 0..columns {
                    let terms: Vec<_> = (0..rows).map(|r| (vector + r, matrix + column * rows + r)).collect();
                    self.dot(i, to + column, &terms);
                }
            }
            Op::Any | Op::All => {
                let to = self.define(i);
                let (from, ty) = self.values[&id(&operands[0])];
                let op = if i.class.opcode == Op::Any { Alu::Or } else { Alu::And };
                self.alu(Alu::Copy, to, [from, 0, 0]);
                (1..self.words(ty)).for_each(|w| self.alu(op, to, [to, from + w, 0]));
            }
            Op::ControlBarrier => {
                let semantics = self.registers[self.at(&operands[2]) as usize];
                self.code.push(Ins::Barrier { buffers: semantics & 0x40 != 0 });
            }
            Op::AtomicIAdd
            | Op::AtomicOr
            | Op::AtomicAnd
            | Op::AtomicSMin
            | Op::AtomicSMax
            | Op::AtomicUMin
            | Op::AtomicUMax => {
                let to = self.define(i);
                let (space, at) = self.pointer(&operands[0]);
                let op = match i.class.opcode {
                    Op::AtomicIAdd => Alu::IAdd,
                    Op::AtomicOr => Alu::Or,
                    Op::AtomicAnd => Alu::And,
                    Op::AtomicSMin => Alu::SMin,
                    Op::AtomicSMax => Alu::SMax,
                    Op::AtomicUMin => Alu::UMin,
                    _ => Alu::UMax,
                };
                self.code.push(Ins::Atomic { op, space, to, at, value: self.at(&operands[3]) });
            }
            Op::GroupNonUniformElect => {
                let to = self.define(i);
                self.code.push(Ins::Group { op: Group::Elect, to, args: [0, 0] });
            }
            Op::GroupNonUniformAny => self.group(i, Group::Any, &operands[1..2]),
            Op::GroupNonUniformShuffle => self.group(i, Group::Shuffle, &operands[1..3]),
            Op::GroupNonUniformShuffleXor => self.group(i, Group::ShuffleXor, &operands[1..3]),
            Op::GroupNonUniformIAdd | Op::GroupNonUniformSMin | Op::GroupNonUniformSMax => {
                let Operand::GroupOperation(operation) = operands[1] else { panic!("{i:?}") };
                let op = match i.class.opcode {
                    Op::GroupNonUniformIAdd => Group::IAdd(operation),
                    _ if operation != GroupOperation::Reduce => panic!("{i:?}"),
                    Op::GroupNonUniformSMin => Group::SMin,
                    _ => Group::SMax,
                };
                self.group(i, op, &operands[2..3]);
            }
            Op::ExtInst => {
                assert_eq!(id(&operands[0]), self.extended, "GLSL's functions alone");
                self.extended_instruction(i);
            }
            _ => self.scalars(i),
        }
    }

    fn group(&mut self, i: &Instruction, op: Group, operands: &[Operand]) {
        let to = self.define(i);
        let args = [0, 1].map(|n| operands.get(n).map_or(0, |o| self.at(o)));
        for w in 0..self.words(i.result_type.expect("typed")) {
            self.code.push(Ins::Group { op, to: to + w, args: [args[0] + w, args[1]] });
        }
    }

    /// A part of a value: its first register and type.
    fn inside(&self, (mut at, mut ty): (u32, u32), path: &[Operand]) -> (u32, u32) {
        for part in path.iter().map(id) {
            match &self.types[&ty] {
                Type::Sequence(element, _) => {
                    ty = *element;
                    at += part * self.words(ty);
                }
                Type::Composite(members) => {
                    at += members[..part as usize].iter().map(|m| self.words(*m)).sum::<u32>();
                    ty = members[part as usize];
                }
                _ => panic!("no parts"),
            }
        }
        (at, ty)
    }

    fn chain(&mut self, i: &Instruction) {
        let to = self.define(i);
        let (space, base) = self.pointer(&i.operands[0]);
        let Type::Pointer(mut ty) = self.types[&self.type_of(&i.operands[0])] else { panic!("{i:?}") };
        let mut parts = vec![];
        let mut constant = 0;
        for index in &i.operands[1..] {
            let at = self.at(index);
            match &self.types[&ty] {
                Type::Composite(members) => {
                    let member = self.registers[at as usize];
                    let natural = || members[..member as usize].iter().map(|m| self.words(*m)).sum();
                    constant += self.offsets.get(&(ty, member)).copied().unwrap_or_else(natural);
                    ty = members[member as usize];
                }
                Type::Sequence(element, count) => {
                    parts.push((at, self.words(*element), Length::Known(*count)));
                    ty = *element;
                }
                Type::Runtime(element) => {
                    let Space::Buffer(place) = space else { panic!("{i:?}") };
                    let words = self.words(*element);
                    parts.push((at, words, Length::Buffer(place, words)));
                    ty = *element;
                }
                _ => panic!("{i:?}"),
            }
        }
        let base = if constant > 0 {
            let more = self.temporary(1);
            self.registers[more as usize] = constant;
            let sum = self.temporary(1);
            self.alu(Alu::IAdd, sum, [base, more, 0]);
            sum
        } else {
            base
        };
        self.spaces.insert(i.result_id.expect("a chain has an id"), space);
        self.code.push(Ins::Chain { to, base, parts });
    }

    fn product(&mut self, i: &Instruction, to: u32, a: u32, b: u32) {
        self.alu(Alu::FMul, to, [a, b, 0]);
        if !self.precise.contains(&i.result_id.unwrap_or(0)) {
            self.products.insert(to, (a, b));
        }
    }

    /// A sum or difference, contracted with a product where that may be and is chosen.
    fn sum(&mut self, i: &Instruction, op: Alu, to: u32, a: u32, b: u32) {
        let free = !self.precise.contains(&i.result_id.unwrap_or(0));
        let factors = |at: &u32| self.products.get(at).copied();
        let contracted = match (op, factors(&a), factors(&b)) {
            (Alu::FAdd, Some((x, y)), _) => Some((Alu::Fused, [x, y, b])),
            (Alu::FAdd, _, Some((x, y))) => Some((Alu::Fused, [x, y, a])),
            (Alu::FSub, Some((x, y)), _) => Some((Alu::FusedMinus, [x, y, b])),
            (Alu::FSub, _, Some((x, y))) => Some((Alu::MinusFused, [x, y, a])),
            _ => None,
        };
        let chosen = contracted.filter(|_| free && self.choices.contract.as_mut().is_some_and(|choose| choose()));
        let (op, args) = chosen.unwrap_or((op, [a, b, 0]));
        self.alu(op, to, args);
    }

    fn dot(&mut self, i: &Instruction, to: u32, terms: &[(u32, u32)]) {
        let mut sum = self.temporary(1);
        self.product(i, sum, terms[0].0, terms[0].1);
        for &(a, b) in &terms[1..] {
            let [product, next] = [0, 1].map(|_| self.temporary(1));
            self.product(i, product, a, b);
            self.sum(i, Alu::FAdd, next, sum, product);
            sum = next;
        }
        self.alu(Alu::Copy, to, [sum, 0, 0]);
    }

    fn scalars(&mut self, i: &Instruction) {
        let op = match i.class.opcode {
            Op::FAdd => Alu::FAdd,
            Op::FSub => Alu::FSub,
            Op::FMul => Alu::FMul,
            Op::FDiv => Alu::FDiv,
            Op::FNegate => Alu::FNeg,
            Op::FOrdLessThan => Alu::FLess,
            Op::FOrdLessThanEqual => Alu::FLessEqual,
            Op::FOrdGreaterThan => Alu::FGreater,
            Op::FOrdGreaterThanEqual => Alu::FGreaterEqual,
            Op::FOrdEqual => Alu::FEqual,
            Op::IAdd => Alu::IAdd,
            Op::ISub => Alu::ISub,
            Op::IMul => Alu::IMul,
            Op::UDiv => Alu::UDiv,
            Op::UMod => Alu::UMod,
            Op::BitwiseAnd | Op::LogicalAnd => Alu::And,
            Op::BitwiseOr | Op::LogicalOr => Alu::Or,
            Op::BitwiseXor | Op::LogicalNotEqual => Alu::Xor,
            Op::Not => Alu::Not,
            Op::LogicalNot => Alu::LogicalNot,
            Op::ShiftLeftLogical => Alu::ShiftLeft,
            Op::ShiftRightLogical => Alu::ShiftRight,
            Op::ULessThan => Alu::ULess,
            Op::ULessThanEqual => Alu::ULessEqual,
            Op::UGreaterThan => Alu::UGreater,
            Op::UGreaterThanEqual => Alu::UGreaterEqual,
            Op::SLessThan => Alu::SLess,
            Op::SLessThanEqual => Alu::SLessEqual,
            Op::SGreaterThan => Alu::SGreater,
            Op::SGreaterThanEqual => Alu::SGreaterEqual,
            Op::IEqual | Op::LogicalEqual => Alu::Equal,
            Op::INotEqual => Alu::NotEqual,
            Op::Bitcast | Op::CopyObject => Alu::Copy,
            Op::BitCount => Alu::BitCount,
            Op::ConvertSToF => Alu::FromSigned,
            Op::ConvertUToF => Alu::FromUnsigned,
            Op::ConvertFToS => Alu::ToSigned,
            Op::ConvertFToU => Alu::ToUnsigned,
            other => panic!("{other:?} is not known"),
        };
        let to = self.define(i);
        let args = [0, 1].map(|n| i.operands.get(n).map_or(0, |o| self.at(o)));
        for w in 0..self.words(i.result_type.expect("typed")) {
            let [a, b] = args.map(|at| at + w);
            match op {
                Alu::FMul => self.product(i, to + w, a, b),
                Alu::FAdd | Alu::FSub => self.sum(i, op, to + w, a, b),
                _ => self.alu(op, to + w, [a, b, 0]),
            }
        }
    }

    fn extended_instruction(&mut self, i: &Instruction) {
        let function = GlslStd450Op::from_u32(id(&i.operands[1])).expect("a function of GLSL's");
        let to = self.define(i);
        let args = [0, 1, 2].map(|n| i.operands.get(2 + n).map_or(0, |o| self.at(o)));
        let words = self.words(i.result_type.expect("typed"));
        let each = match function {
            GlslStd450Op::Exp => Alu::Exp,
            GlslStd450Op::Log => Alu::Log,
            GlslStd450Op::Sqrt => Alu::Sqrt,
            GlslStd450Op::InverseSqrt => Alu::InverseSqrt,
            GlslStd450Op::FAbs => Alu::FAbs,
            GlslStd450Op::FSign => Alu::FSign,
            GlslStd450Op::FMin => Alu::FMin,
            GlslStd450Op::FMax => Alu::FMax,
            GlslStd450Op::UMin => Alu::UMin,
            GlslStd450Op::UMax => Alu::UMax,
            GlslStd450Op::SMin => Alu::SMin,
            GlslStd450Op::SMax => Alu::SMax,
            GlslStd450Op::Floor => Alu::Floor,
            GlslStd450Op::Ceil => Alu::Ceil,
            GlslStd450Op::RoundEven => Alu::RoundEven,
            GlslStd450Op::FindILsb => Alu::FindLeast,
            GlslStd450Op::Fma => Alu::Fma,
            GlslStd450Op::FClamp | GlslStd450Op::SClamp | GlslStd450Op::UClamp => {
                let (most, least) = match function {
                    GlslStd450Op::FClamp => (Alu::FMax, Alu::FMin),
                    GlslStd450Op::SClamp => (Alu::SMax, Alu::SMin),
                    _ => (Alu::UMax, Alu::UMin),
                };
                for w in 0..words {
                    self.alu(most, to + w, [args[0] + w, args[1] + w, 0]);
                    self.alu(least, to + w, [to + w, args[2] + w, 0]);
                }
                return;
            }
            GlslStd450Op::FMix => {
                let one = self.temporary(1);
                self.registers[one as usize] = 1f32.to_bits();
                for w in 0..words {
                    let [rest, x, y] = [0, 1, 2].map(|_| self.temporary(1));
                    self.alu(Alu::FSub, rest, [one, args[2] + w, 0]);
                    self.alu(Alu::FMul, x, [args[0] + w, rest, 0]);
                    self.alu(Alu::FMul, y, [args[1] + w, args[2] + w, 0]);
                    self.alu(Alu::FAdd, to + w, [x, y, 0]);
                }
                return;
            }
            GlslStd450Op::Length => {
                let count = self.words(self.type_of(&i.operands[2]));
                let square = self.temporary(1);
                self.dot(i, square, &(0..count).map(|w| (args[0] + w, args[0] + w)).collect::<Vec<_>>());
                self.alu(Alu::Sqrt, to, [square, 0, 0]);
                return;
            }
            GlslStd450Op::Cross => {
                for w in 0..3 {
                    let (u, v) = ((w + 1) % 3, (w + 2) % 3);
                    let [x, y] = [0, 1].map(|_| self.temporary(1));
                    self.alu(Alu::FMul, x, [args[0] + u, args[1] + v, 0]);
                    self.alu(Alu::FMul, y, [args[0] + v, args[1] + u, 0]);
                    self.alu(Alu::FSub, to + w, [x, y, 0]);
                }
                return;
            }
            other => panic!("{other:?} is not known"),
        };
        (0..words).for_each(|w| self.alu(each, to + w, args.map(|at| at + w)));
    }
}
