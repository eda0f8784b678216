//! Faults planted into modules, as a mistake in GLSL would put them there.

use std::collections::HashMap;

use rspirv::dr::{Instruction, Module, Operand};
use rspirv::spirv::{BuiltIn, Decoration, GroupOperation, Op, StorageClass, Word};

/// A mistake, and what says that it was found.
pub struct Fault {
    pub name: &'static str,
    /// Kernels into which it is planted.
    pub kernels: &'static [&'static str],
    /// Plants it; false where the module has no place for it.
    pub plant: fn(&mut Module) -> bool,
    /// A part of what is said.
    pub said: &'static str,
}

pub const ALL: [Fault; 14] = [
    Fault {
        name: "the barrier between writing and reading shared memory is lost",
        kernels: &["primitives/scan_sums", "losses/sum"],
        plant: |m| drop_nth(m, 0, |i, _| i.class.opcode == Op::ControlBarrier),
        said: "uninitialised",
    },
    Fault {
        name: "the last barrier is lost",
        kernels: &["primitives/sort_scatter", "primitives/sort_scatter_index", "render/decode_backward_hidden"],
        plant: |m| {
            let last = count(m, |i, _| i.class.opcode == Op::ControlBarrier);
            last > 0 && drop_nth(m, last - 1, |i, _| i.class.opcode == Op::ControlBarrier)
        },
        said: "Shared",
    },
    Fault {
        name: "shared memory is read before it is written",
        kernels: &["primitives/scan_sums", "losses/sum", "render/decode_hidden"],
        plant: |m| {
            drop_nth(m, 0, |i, at| i.class.opcode == Op::Store && at.of(&i.operands[0]) == StorageClass::Workgroup)
        },
        said: "uninitialised",
    },
    Fault {
        name: "a write's index is off by one",
        kernels: &["densify/statistics", "primitives/scan_spread"],
        plant: |m| off_by_one(m, Op::Store),
        said: "",
    },
    Fault {
        name: "a read's index is off by one",
        kernels: &["render/project"],
        plant: |m| off_by_one(m, Op::Load),
        said: "out of bounds",
    },
    Fault {
        name: "the check of the thread's number is lost",
        kernels: &["render/cull"],
        plant: always,
        said: "out of bounds",
    },
    Fault {
        name: "threads beyond the end write where others do",
        kernels: &["render/project"],
        plant: always,
        said: "race",
    },
    Fault {
        name: "the local index is taken for the lane",
        kernels: &["primitives/scan_sums", "primitives/sort_scatter"],
        plant: |m| other_built_in(m, BuiltIn::SubgroupLocalInvocationId, BuiltIn::LocalInvocationIndex),
        said: "",
    },
    Fault {
        name: "the thread is taken for the workgroup in what all threads decide",
        kernels: &["render/rasterize_depth", "render/rasterize_backward_depth"],
        plant: |m| other_built_in(m, BuiltIn::WorkgroupId, BuiltIn::LocalInvocationId),
        said: "",
    },
    Fault {
        name: "some threads of a workgroup return before a barrier",
        kernels: &["losses/sum"],
        plant: |m| other_built_in(m, BuiltIn::WorkgroupId, BuiltIn::LocalInvocationId),
        said: "divergence",
    },
    Fault {
        name: "an atomic operation is a read and a write",
        kernels: &["render/rasterize_depth", "model/attention_select"],
        plant: not_atomic,
        said: "race",
    },
    Fault {
        name: "a shuffle looks beyond the subgroup",
        kernels: &["render/rasterize_backward_depth"],
        plant: beyond_the_subgroup,
        said: "a shuffle reads lane",
    },
    Fault {
        name: "a scan leaves its own term out",
        kernels: &["primitives/scan_sums", "primitives/scan_totals"],
        plant: |m| {
            edit(m, 1, |i, _| {
                let inclusive = Operand::GroupOperation(GroupOperation::InclusiveScan);
                let found = i.class.opcode == Op::GroupNonUniformIAdd && i.operands.get(1) == Some(&inclusive);
                if found {
                    i.operands[1] = Operand::GroupOperation(GroupOperation::ExclusiveScan);
                }
                found
            })
        },
        said: "",
    },
    Fault {
        name: "a difference has the other sign",
        kernels: &["render/project_backward"],
        plant: |m| {
            edit(m, 1, |i, _| {
                let found = i.class.opcode == Op::FSub;
                if found {
                    i.operands.swap(0, 1);
                }
                found
            })
        },
        said: "",
    },
];

/// Storage classes of what pointers lead to.
pub struct Classes(HashMap<Word, StorageClass>);

impl Classes {
    fn of(&self, pointer: &Operand) -> StorageClass {
        let Operand::IdRef(id) = pointer else { panic!("a pointer's id") };
        self.0[id]
    }

    fn of_module(module: &Module) -> Self {
        let mut classes = HashMap::new();
        let variables = module.types_global_values.iter().chain(instructions(module));
        for i in variables {
            let class = match (i.class.opcode, i.operands.as_slice()) {
                (Op::Variable, [Operand::StorageClass(class), ..]) => Some(*class),
                (Op::AccessChain | Op::InBoundsAccessChain, [Operand::IdRef(base), ..]) => classes.get(base).copied(),
                _ => None,
            };
            if let (Some(class), Some(id)) = (class, i.result_id) {
                classes.insert(id, class);
            }
        }
        Self(classes)
    }
}

fn instructions(module: &Module) -> impl Iterator<Item = &Instruction> {
    module.functions.iter().flat_map(|f| &f.blocks).flat_map(|b| &b.instructions)
}

fn count(module: &Module, is: impl Fn(&Instruction, &Classes) -> bool) -> usize {
    let classes = Classes::of_module(module);
    instructions(module).filter(|i| is(i, &classes)).count()
}

/// Takes the instruction out that is the nth of its kind.
fn drop_nth(module: &mut Module, nth: usize, is: impl Fn(&Instruction, &Classes) -> bool) -> bool {
    let classes = Classes::of_module(module);
    let mut met = 0;
    for block in module.functions.iter_mut().flat_map(|f| &mut f.blocks) {
        for at in 0..block.instructions.len() {
            if is(&block.instructions[at], &classes) {
                if met == nth {
                    block.instructions.remove(at);
                    return true;
                }
                met += 1;
            }
        }
    }
    false
}

/// Changes up to so many instructions.
fn edit(module: &mut Module, most: usize, mut change: impl FnMut(&mut Instruction, &Classes) -> bool) -> bool {
    let classes = Classes::of_module(module);
    let mut changed = 0;
    for i in module.functions.iter_mut().flat_map(|f| &mut f.blocks).flat_map(|b| &mut b.instructions) {
        if changed < most && change(i, &classes) {
            changed += 1;
        }
    }
    changed > 0
}

fn fresh(module: &mut Module) -> Word {
    let header = module.header.as_mut().expect("a module has a header");
    header.bound += 1;
    header.bound - 1
}

fn of_opcode(module: &Module, opcode: Op, operands: &[Operand]) -> Option<Word> {
    let same = |i: &&Instruction| i.class.opcode == opcode && i.operands == operands;
    module.types_global_values.iter().find(same).and_then(|i| i.result_id)
}

fn uint(module: &Module) -> Word {
    let operands = [Operand::LiteralBit32(32), Operand::LiteralBit32(0)];
    of_opcode(module, Op::TypeInt, &operands).expect("kernels have unsigned integers")
}

fn constant(module: &mut Module, value: u32) -> Word {
    let (ty, id) = (uint(module), fresh(module));
    let new = Instruction::new(Op::Constant, Some(ty), Some(id), vec![Operand::LiteralBit32(value)]);
    let after = module.types_global_values.iter().position(|i| i.result_id == Some(ty)).map_or(0, |at| at + 1);
    module.types_global_values.insert(after, new);
    id
}

/// Adds one to the last index of the first access of a buffer by this operation.
fn off_by_one(module: &mut Module, by: Op) -> bool {
    let classes = Classes::of_module(module);
    let accessed: Vec<Word> = instructions(module)
        .filter(|i| i.class.opcode == by)
        .filter_map(|i| match i.operands[0] {
            Operand::IdRef(id) if classes.0.get(&id) == Some(&StorageClass::StorageBuffer) => Some(id),
            _ => None,
        })
        .collect();
    let (ty, one, sum) = (uint(module), constant(module, 1), fresh(module));
    for block in module.functions.iter_mut().flat_map(|f| &mut f.blocks) {
        let chain = |i: &Instruction| {
            i.class.opcode == Op::AccessChain && i.operands.len() == 3 && accessed.contains(&i.result_id.unwrap_or(0))
        };
        if let Some(at) = block.instructions.iter().position(chain) {
            let index = block.instructions[at].operands[2].clone();
            block.instructions[at].operands[2] = Operand::IdRef(sum);
            let add = Instruction::new(Op::IAdd, Some(ty), Some(sum), vec![index, Operand::IdRef(one)]);
            block.instructions.insert(at, add);
            return true;
        }
    }
    false
}

/// The first condition of an unsigned comparison holds always.
fn always(module: &mut Module) -> bool {
    let compared: Vec<Word> = instructions(module)
        .filter(|i| matches!(i.class.opcode, Op::UGreaterThanEqual | Op::ULessThan))
        .filter_map(|i| i.result_id)
        .collect();
    // Threads beyond the end return at once, or go on below it.
    let first = instructions(module).find(|i| i.result_id.is_some_and(|id| compared.contains(&id))).cloned();
    let Some(first) = first else { return false };
    let zero = constant(module, if first.class.opcode == Op::UGreaterThanEqual { 0 } else { u32::MAX });
    let (left, right) = match first.class.opcode {
        // 0 >= MAX never holds, 0 < MAX always does.
        Op::UGreaterThanEqual => (zero, constant(module, u32::MAX)),
        _ => (constant(module, 0), zero),
    };
    edit(module, 1, |i, _| {
        let found = i.result_id == first.result_id;
        if found {
            i.operands = vec![Operand::IdRef(left), Operand::IdRef(right)];
        }
        found
    })
}

/// A built-in variable is another.
fn other_built_in(module: &mut Module, from: BuiltIn, to: BuiltIn) -> bool {
    let mut found = false;
    for i in &mut module.annotations {
        if let [_, Operand::Decoration(Decoration::BuiltIn), Operand::BuiltIn(built_in)] = i.operands.as_mut_slice()
            && *built_in == from
        {
            *built_in = to;
            found = true;
        }
    }
    found
}

/// The first atomic operation is a load, an operation and a store.
fn not_atomic(module: &mut Module) -> bool {
    let sum = fresh(module);
    for block in module.functions.iter_mut().flat_map(|f| &mut f.blocks) {
        let plain = |i: &Instruction| match i.class.opcode {
            Op::AtomicIAdd => Some(Op::IAdd),
            Op::AtomicOr => Some(Op::BitwiseOr),
            Op::AtomicAnd => Some(Op::BitwiseAnd),
            _ => None,
        };
        let Some(at) = block.instructions.iter().position(|i| plain(i).is_some()) else { continue };
        let atomic = block.instructions[at].clone();
        let (pointer, value) = (atomic.operands[0].clone(), atomic.operands[3].clone());
        let old = atomic.result_id.expect("it has a result");
        let op = plain(&atomic).expect("it was found");
        block.instructions.splice(
            at..=at,
            [
                Instruction::new(Op::Load, atomic.result_type, Some(old), vec![pointer.clone()]),
                Instruction::new(op, atomic.result_type, Some(sum), vec![Operand::IdRef(old), value]),
                Instruction::new(Op::Store, None, None, vec![pointer, Operand::IdRef(sum)]),
            ],
        );
        return true;
    }
    false
}

/// The first shuffle's distance is that of the largest subgroup.
fn beyond_the_subgroup(module: &mut Module) -> bool {
    let far = constant(module, 64);
    edit(module, 1, |i, _| {
        let found = i.class.opcode == Op::GroupNonUniformShuffleXor;
        if found {
            i.operands[2] = Operand::IdRef(far);
        }
        found
    })
}
