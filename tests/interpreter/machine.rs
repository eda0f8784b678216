//! Runs a program as a hostile device might: invocations in any order, subgroups of any size with any lanes, and every
//! access watched.
//!
//! Invocations run alone until they wait for others, so that a run is one of many that a device may choose. What is found
//! does not hang on the choice: a race is two accesses of one word without a barrier between them, in whichever order they came.

use rand::seq::SliceRandom as _;
use rand::{RngExt as _, SeedableRng as _};
use rand_pcg::Pcg64Mcg;
use rspirv::spirv::{BuiltIn, GroupOperation};

use super::code::{Alu, Edge, Group, Ins, Length, Space};
use super::program::Program;

/// How a device behaves where it is free to.
#[derive(Clone, Copy, Debug)]
pub struct Manner {
    pub seed: u64,
    /// Threads of a subgroup.
    pub subgroup: u32,
    /// Invocations are dealt to lanes at random, and run in any order.
    pub shuffled: bool,
    /// Products and sums are rounded together where nothing forbids it, or not.
    pub contracted: bool,
    /// Errors of functions and divisions are as large as Vulkan allows.
    pub noisy: bool,
    /// Denormal numbers are zero.
    pub flushed: bool,
}

/// A dispatch.
pub struct Launch<'l> {
    pub workgroups: [u32; 3],
    pub push: &'l [u32],
    /// Words of every binding.
    pub buffers: Vec<Vec<u32>>,
    /// Bindings that are written: accesses of others race with nothing.
    pub written: Vec<bool>,
}

/// Instructions of an invocation after which it is taken not to end.
const ENDLESS: u64 = 200_000_000;
/// An address that leads nowhere.
const NOWHERE: u32 = u32::MAX;
/// Reader of a word that more than one invocation read.
const MANY: u32 = u32::MAX;

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum State {
    Ready,
    AtGroup,
    AtBarrier,
    Done,
}

struct Invocation {
    registers: Vec<u32>,
    private: Vec<u32>,
    initialised: Vec<bool>,
    input: Vec<u32>,
    at: usize,
    /// Place and turn of every loop around it.
    path: Vec<(u32, u32)>,
    state: State,
    /// Number in the dispatch, from 1 on.
    number: u32,
    subgroup: u32,
    lane: u32,
    instructions: u64,
}

/// Who touched a word last, and between which barriers.
#[derive(Clone, Copy, Default)]
struct Touch {
    writer: u32,
    written: u32,
    atomic: bool,
    reader: u32,
    read: u32,
    read_atomic: bool,
}

impl Touch {
    /// Notes an access; what it races with.
    fn note(&mut self, who: u32, when: u32, writes: bool, atomic: bool) -> Option<&'static str> {
        let other_wrote = self.writer != 0 && self.writer != who && self.written == when && !(self.atomic && atomic);
        let other_read =
            self.reader != 0 && self.reader != who && self.read == when && !(self.read_atomic && atomic) && writes;
        if writes {
            (self.writer, self.written, self.atomic) = (who, when, atomic);
        }
        if !writes || atomic {
            let same = self.read == when && self.reader != 0 && self.reader != who;
            self.read_atomic = atomic && (!same || self.read_atomic);
            (self.reader, self.read) = (if same { MANY } else { who }, when);
        }
        match (other_wrote, other_read) {
            (true, _) if writes => Some("two writes"),
            (true, _) => Some("a read and a write"),
            (_, true) => Some("a write and a read"),
            _ => None,
        }
    }
}

struct Machine<'m> {
    program: &'m Program,
    launch: Launch<'m>,
    manner: Manner,
    shared: Vec<u32>,
    shared_initialised: Vec<bool>,
    shared_touched: Vec<Touch>,
    touched: Vec<Vec<Touch>>,
    /// Barriers so far.
    shared_time: u32,
    moved: Vec<u32>,
    instructions: u64,
}

/// Runs a dispatch and returns the bindings' words, and the number of instructions.
///
/// # Errors
/// What is wrong with the kernel.
pub fn run(program: &Program, launch: Launch<'_>, manner: Manner) -> Result<(Vec<Vec<u32>>, u64), String> {
    let touched = launch.buffers.iter().zip(&launch.written);
    let touched = touched.map(|(words, written)| vec![Touch::default(); if *written { words.len() } else { 0 }]);
    let mut machine = Machine {
        touched: touched.collect(),
        shared: vec![0; program.shared_words as usize],
        shared_initialised: vec![false; program.shared_words as usize],
        shared_touched: vec![Touch::default(); program.shared_words as usize],
        shared_time: 0,
        moved: vec![],
        instructions: 0,
        program,
        launch,
        manner,
    };
    machine.dispatch()?;
    Ok((machine.launch.buffers, machine.instructions))
}

impl Machine<'_> {
    fn dispatch(&mut self) -> Result<(), String> {
        let [x, y, z] = self.launch.workgroups;
        let mut all: Vec<[u32; 3]> =
            (0..z).flat_map(|z| (0..y).flat_map(move |y| (0..x).map(move |x| [x, y, z]))).collect();
        let mut random = Pcg64Mcg::seed_from_u64(self.manner.seed);
        if self.manner.shuffled {
            all.shuffle(&mut random);
        }
        let [sx, sy, sz] = self.program.group;
        let threads = (sx * sy * sz) as usize;
        let mut invocations: Vec<Invocation> = (0..threads)
            .map(|_| Invocation {
                registers: self.program.registers.clone(),
                private: vec![0; self.program.private_words as usize],
                initialised: vec![false; self.program.private_words as usize],
                input: vec![0; self.program.input_words as usize],
                at: 0,
                path: vec![],
                state: State::Ready,
                number: 0,
                subgroup: 0,
                lane: 0,
                instructions: 0,
            })
            .collect();
        for (turn, workgroup) in all.into_iter().enumerate() {
            let mut places: Vec<u32> = (0..threads as u32).collect();
            if self.manner.shuffled {
                places.shuffle(&mut random);
            }
            for (local, place) in places.into_iter().enumerate() {
                self.begin(&mut invocations[local], turn as u32, workgroup, local as u32, place);
            }
            self.shared.iter_mut().for_each(|word| *word = random.random());
            self.shared_initialised.fill(false);
            self.shared_time += 1;
            self.workgroup(&mut invocations, &mut random)
                .map_err(|fault| format!("{fault}, workgroup {workgroup:?}"))?;
        }
        Ok(())
    }

    fn begin(&self, invocation: &mut Invocation, turn: u32, workgroup: [u32; 3], local: u32, place: u32) {
        let Program { registers, group, initial, built_ins, .. } = self.program;
        let threads: u32 = group.iter().product();
        let size = self.manner.subgroup;
        invocation.registers.copy_from_slice(registers);
        invocation.initialised.fill(false);
        for &(at, word) in initial {
            invocation.private[at as usize] = word;
            invocation.initialised[at as usize] = true;
        }
        (invocation.at, invocation.state, invocation.instructions) = (0, State::Ready, 0);
        invocation.path.clear();
        invocation.number = turn * threads + local + 1;
        (invocation.subgroup, invocation.lane) = (place / size, place % size);
        let within = [local % group[0], local / group[0] % group[1], local / (group[0] * group[1])];
        for &(built_in, at) in built_ins {
            let words: [u32; 3] = match built_in {
                BuiltIn::WorkgroupId => workgroup,
                BuiltIn::NumWorkgroups => self.launch.workgroups,
                BuiltIn::LocalInvocationId => within,
                BuiltIn::GlobalInvocationId => std::array::from_fn(|i| workgroup[i] * group[i] + within[i]),
                BuiltIn::LocalInvocationIndex => [local, 0, 0],
                BuiltIn::SubgroupId => [invocation.subgroup, 0, 0],
                BuiltIn::SubgroupLocalInvocationId => [invocation.lane, 0, 0],
                BuiltIn::SubgroupSize => [size, 0, 0],
                BuiltIn::NumSubgroups => [threads.div_ceil(size), 0, 0],
                other => panic!("{other:?} is not known"),
            };
            for (to, word) in invocation.input[at as usize..].iter_mut().zip(words) {
                *to = word;
            }
        }
    }

    fn workgroup(&mut self, invocations: &mut [Invocation], random: &mut Pcg64Mcg) -> Result<(), String> {
        let subgroups = invocations.iter().map(|i| i.subgroup).max().unwrap_or(0) + 1;
        let mut members: Vec<Vec<usize>> = vec![vec![]; subgroups as usize];
        invocations.iter().enumerate().for_each(|(at, i)| members[i.subgroup as usize].push(at));
        let mut order: Vec<usize> = (0..invocations.len()).collect();
        loop {
            if self.manner.shuffled {
                order.shuffle(random);
            }
            for &at in &order {
                if invocations[at].state == State::Ready {
                    self.advance(&mut invocations[at])?;
                }
            }
            // Whoever waits for its subgroup and is furthest behind, with all lanes that are as far.
            let mut went_on = false;
            for lanes in &members {
                let waiting = lanes.iter().copied().filter(|&at| invocations[at].state == State::AtGroup);
                let place = |at: usize| (&invocations[at].path, invocations[at].at);
                let Some(first) = waiting.clone().min_by(|&a, &b| before(place(a), place(b))) else { continue };
                let together: Vec<usize> = waiting.filter(|&at| place(at) == place(first)).collect();
                self.together(invocations, &together)?;
                went_on = true;
            }
            if went_on {
                continue;
            }
            let Some(first) = invocations.iter().find(|i| i.state == State::AtBarrier) else { return Ok(()) };
            let together =
                invocations.iter().all(|i| i.state == State::AtBarrier && i.at == first.at && i.path == first.path);
            if !together {
                let there = invocations.iter().filter(|i| i.state == State::AtBarrier && i.at == first.at).count();
                return Err(format!("divergence: {there} of {} invocations are at a barrier", invocations.len()));
            }
            let Ins::Barrier { buffers } = self.program.code[first.at] else { panic!("they wait at a barrier") };
            assert!(!buffers, "a barrier that orders buffers: accesses of buffers are watched as if none did");
            self.shared_time += 1;
            for invocation in invocations.iter_mut() {
                (invocation.at, invocation.state) = (invocation.at + 1, State::Ready);
            }
        }
    }

    /// An operation of these lanes.
    fn together(&mut self, all: &mut [Invocation], lanes: &[usize]) -> Result<(), String> {
        let Ins::Group { op, to, args } = self.program.code[all[lanes[0]].at] else {
            panic!("they wait for each other")
        };
        let mut ordered = lanes.to_vec();
        ordered.sort_by_key(|&at| all[at].lane);
        let value = |at: usize, n: usize| all[at].registers[args[n] as usize];
        let from_lane = |lane: u32| {
            let from = ordered.iter().find(|&&at| all[at].lane == lane);
            from.map(|&at| value(at, 0)).ok_or_else(|| format!("a shuffle reads lane {lane}, which is not there"))
        };
        let results: Vec<u32> = match op {
            Group::Elect => ordered.iter().enumerate().map(|(n, _)| u32::from(n == 0)).collect(),
            Group::Any => {
                let any = ordered.iter().any(|&at| value(at, 0) != 0);
                vec![u32::from(any); ordered.len()]
            }
            Group::Shuffle => ordered.iter().map(|&at| from_lane(value(at, 1))).collect::<Result<_, _>>()?,
            Group::ShuffleXor => {
                ordered.iter().map(|&at| from_lane(all[at].lane ^ value(at, 1))).collect::<Result<_, _>>()?
            }
            Group::IAdd(operation) => {
                let mut sum = 0u32;
                let mut sums = vec![];
                for &at in &ordered {
                    let before = sum;
                    sum = sum.wrapping_add(value(at, 0));
                    sums.push(if operation == GroupOperation::ExclusiveScan { before } else { sum });
                }
                if operation == GroupOperation::Reduce { vec![sum; sums.len()] } else { sums }
            }
            Group::SMin | Group::SMax => {
                let values = ordered.iter().map(|&at| value(at, 0) as i32);
                let found = if op == Group::SMin { values.min() } else { values.max() }.expect("lanes");
                vec![found as u32; ordered.len()]
            }
        };
        for (&at, result) in ordered.iter().zip(results) {
            let invocation = &mut all[at];
            invocation.registers[to as usize] = result;
            (invocation.at, invocation.state) = (invocation.at + 1, State::Ready);
        }
        Ok(())
    }

    /// Runs an invocation until it waits or ends.
    fn advance(&mut self, i: &mut Invocation) -> Result<(), String> {
        let program = self.program;
        let mut count = 0u64;
        let outcome = loop {
            count += 1;
            match &program.code[i.at] {
                Ins::Alu { op, to, args } => {
                    let [a, b, c] = args.map(|at| i.registers[at as usize]);
                    i.registers[*to as usize] = self.alu(*op, a, b, c, i.at);
                }
                Ins::Chain { to, base, parts } => {
                    let mut address = i.registers[*base as usize];
                    for (index, stride, length) in parts {
                        let index = i.registers[*index as usize];
                        let length = match *length {
                            Length::Known(n) => n,
                            Length::Buffer(place, words) => (self.launch.buffers[place].len() as u32) / words,
                        };
                        if index >= length || address == NOWHERE {
                            address = NOWHERE;
                        } else {
                            address += index * stride;
                        }
                    }
                    i.registers[*to as usize] = address;
                }
                Ins::Load { space, to, at, words } => {
                    let address = i.registers[*at as usize];
                    for word in 0..*words {
                        let address = if address == NOWHERE { NOWHERE } else { address + word };
                        let found = self.load(i, *space, address)?;
                        i.registers[(to + word) as usize] = found;
                    }
                }
                Ins::Store { space, from, at, words } => {
                    let address = i.registers[*at as usize];
                    for word in 0..*words {
                        let address = if address == NOWHERE { NOWHERE } else { address + word };
                        let value = i.registers[(from + word) as usize];
                        self.store(i, *space, address, value, false)?;
                    }
                }
                Ins::Atomic { op, space, to, at, value } => {
                    let address = i.registers[*at as usize];
                    let old = self.peek(i, *space, address)?;
                    let new = self.alu(*op, old, i.registers[*value as usize], 0, i.at);
                    self.store(i, *space, address, new, true)?;
                    i.registers[*to as usize] = old;
                }
                Ins::Group { .. } => {
                    i.state = State::AtGroup;
                    break Ok(());
                }
                Ins::Barrier { .. } => {
                    i.state = State::AtBarrier;
                    break Ok(());
                }
                Ins::Return => {
                    i.state = State::Done;
                    break Ok(());
                }
                Ins::Jump(edge) => {
                    self.go(i, &program.edges[*edge]);
                    continue;
                }
                Ins::Branch { condition, edges } => {
                    let taken = if i.registers[*condition as usize] != 0 { edges[0] } else { edges[1] };
                    self.go(i, &program.edges[taken]);
                    i.instructions += 1;
                    if count > ENDLESS {
                        break Err("an invocation does not end".to_owned());
                    }
                    continue;
                }
                Ins::Switch { selector, default, cases } => {
                    let word = i.registers[*selector as usize];
                    let taken = cases.iter().find(|(case, _)| *case == word).map_or(*default, |(_, edge)| *edge);
                    self.go(i, &program.edges[taken]);
                    continue;
                }
            }
            i.at += 1;
        };
        self.instructions += count;
        outcome
    }

    fn go(&mut self, i: &mut Invocation, edge: &Edge) {
        match edge.moves.as_slice() {
            [] => {}
            [(from, to)] => i.registers[*to as usize] = i.registers[*from as usize],
            moves => {
                self.moved.clear();
                self.moved.extend(moves.iter().map(|(from, _)| i.registers[*from as usize]));
                for ((_, to), word) in moves.iter().zip(&self.moved) {
                    i.registers[*to as usize] = *word;
                }
            }
        }
        i.path.truncate(edge.keep);
        if edge.again {
            i.path.last_mut().expect("the loop is around it").1 += 1;
        }
        i.path.extend(edge.enter.iter().map(|&header| (header, 0)));
        i.at = edge.target;
    }

    /// Watches an access. Barriers order shared memory alone: two invocations that touch a word of a buffer are never
    /// ordered within a dispatch.
    fn note(&mut self, i: &Invocation, space: Space, address: u32, writes: bool, atomic: bool) -> Result<(), String> {
        let (touch, when) = match space {
            Space::Shared => (&mut self.shared_touched[address as usize], self.shared_time),
            Space::Buffer(place) if self.launch.written[place] => (&mut self.touched[place][address as usize], 1),
            _ => return Ok(()),
        };
        match touch.note(i.number, when, writes, atomic) {
            None => Ok(()),
            Some(kinds) => Err(format!("race: {kinds} of word {address} of {space:?} by two invocations")),
        }
    }

    fn load(&mut self, i: &Invocation, space: Space, address: u32) -> Result<u32, String> {
        let found = self.peek(i, space, address)?;
        self.note(i, space, address, false, false)?;
        Ok(found)
    }

    fn peek(&self, i: &Invocation, space: Space, address: u32) -> Result<u32, String> {
        let at = address as usize;
        let words = match space {
            Space::Buffer(place) => &self.launch.buffers[place],
            Space::Shared => &self.shared,
            Space::Private => &i.private,
            Space::Push => self.launch.push,
            Space::Input => &i.input,
        };
        let word = words.get(at).copied();
        let word = word.ok_or_else(|| format!("out of bounds: a read of {space:?} ({} words)", words.len()))?;
        let initialised = match space {
            Space::Shared => self.shared_initialised[at],
            Space::Private => i.initialised[at],
            _ => true,
        };
        if initialised { Ok(word) } else { Err(format!("uninitialised: word {address} of {space:?} is read")) }
    }

    fn store(
        &mut self,
        i: &mut Invocation,
        space: Space,
        address: u32,
        value: u32,
        atomic: bool,
    ) -> Result<(), String> {
        let at = address as usize;
        let words = match space {
            Space::Buffer(place) => &mut self.launch.buffers[place],
            Space::Shared => &mut self.shared,
            Space::Private => &mut i.private,
            Space::Push | Space::Input => return Err(format!("a write into {space:?}")),
        };
        let length = words.len();
        let word =
            words.get_mut(at).ok_or_else(|| format!("out of bounds: a write into {space:?} ({length} words)"))?;
        *word = value;
        match space {
            Space::Shared => self.shared_initialised[at] = true,
            Space::Private => i.initialised[at] = true,
            _ => {}
        }
        self.note(i, space, address, true, atomic)
    }

    fn alu(&self, op: Alu, a: u32, b: u32, c: u32, at: usize) -> u32 {
        let flush = |word: u32| {
            let denormal = self.manner.flushed && word & 0x7f80_0000 == 0;
            f32::from_bits(if denormal { word & 0x8000_0000 } else { word })
        };
        let float = |value: f32| flush(value.to_bits()).to_bits();
        // The same instruction of the same numbers errs alike.
        let noise = |value: f32, ulps: f32| {
            if !self.manner.noisy || !value.is_finite() {
                return value;
            }
            let mut random = Pcg64Mcg::seed_from_u64(
                self.manner.seed
                    ^ (u64::from(a) << 32 | u64::from(b))
                    ^ (at as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15),
            );
            let share: f32 = random.random_range(-1.0..=1.0);
            value + value * (share * ulps * f32::EPSILON)
        };
        let (x, y, z) = (flush(a), flush(b), flush(c));
        let truth = u32::from;
        match op {
            Alu::Copy => a,
            Alu::FAdd => float(x + y),
            Alu::FSub => float(x - y),
            Alu::FMul => float(x * y),
            Alu::FDiv => float(noise(x / y, 2.5)),
            Alu::FNeg => (-f32::from_bits(a)).to_bits(),
            Alu::Fused => float(x.mul_add(y, z)),
            Alu::FusedMinus => float(x.mul_add(y, -z)),
            Alu::MinusFused => float((-x).mul_add(y, z)),
            Alu::Fma if self.manner.contracted && (at as u64 + self.manner.seed).is_multiple_of(2) => {
                float(float_sum(x * y, z))
            }
            Alu::Fma => float(x.mul_add(y, z)),
            Alu::FMin => float(if y < x { y } else { x }),
            Alu::FMax => float(if x < y { y } else { x }),
            Alu::FAbs => a & 0x7fff_ffff,
            Alu::FSign => float(if x > 0.0 {
                1.0
            } else if x < 0.0 {
                -1.0
            } else {
                0.0
            }),
            Alu::Floor => float(x.floor()),
            Alu::Ceil => float(x.ceil()),
            Alu::RoundEven => float(x.round_ties_even()),
            Alu::Exp => float(noise(x.exp(), 3.0 + 2.0 * x.abs())),
            // Within [1/2, 2] the error is absolute: 2^-21.
            Alu::Log if (0.5..=2.0).contains(&x) => float(x.ln() + noise(1.0, 4.0) - 1.0),
            Alu::Log => float(noise(x.ln(), 3.0)),
            Alu::Sqrt => float(noise(x.sqrt(), 3.0)),
            Alu::InverseSqrt => float(noise(1.0 / x.sqrt(), 2.0)),
            Alu::FLess => truth(x < y),
            Alu::FLessEqual => truth(x <= y),
            Alu::FGreater => truth(x > y),
            Alu::FGreaterEqual => truth(x >= y),
            Alu::FEqual => truth(x == y),
            Alu::IAdd => a.wrapping_add(b),
            Alu::ISub => a.wrapping_sub(b),
            Alu::IMul => a.wrapping_mul(b),
            Alu::UDiv => a.checked_div(b).unwrap_or(0xdead_beef),
            Alu::UMod => a.checked_rem(b).unwrap_or(0xdead_beef),
            Alu::And => a & b,
            Alu::Or => a | b,
            Alu::Xor => a ^ b,
            Alu::Not => !a,
            Alu::LogicalNot => truth(a == 0),
            Alu::ShiftLeft => a.checked_shl(b).unwrap_or(0xdead_beef),
            Alu::ShiftRight => a.checked_shr(b).unwrap_or(0xdead_beef),
            Alu::ULess => truth(a < b),
            Alu::ULessEqual => truth(a <= b),
            Alu::UGreater => truth(a > b),
            Alu::UGreaterEqual => truth(a >= b),
            Alu::SLess => truth((a as i32) < b as i32),
            Alu::SLessEqual => truth(a as i32 <= b as i32),
            Alu::SGreater => truth(a as i32 > b as i32),
            Alu::SGreaterEqual => truth(a as i32 >= b as i32),
            Alu::Equal => truth(a == b),
            Alu::NotEqual => truth(a != b),
            Alu::UMin => a.min(b),
            Alu::UMax => a.max(b),
            Alu::SMin => (a as i32).min(b as i32) as u32,
            Alu::SMax => (a as i32).max(b as i32) as u32,
            Alu::BitCount => a.count_ones(),
            Alu::FindLeast => {
                if a == 0 {
                    u32::MAX
                } else {
                    a.trailing_zeros()
                }
            }
            Alu::Select => {
                if a != 0 {
                    b
                } else {
                    c
                }
            }
            Alu::FromSigned => (a as i32 as f32).to_bits(),
            Alu::FromUnsigned => (a as f32).to_bits(),
            Alu::ToSigned => x as i32 as u32,
            Alu::ToUnsigned => x as u32,
        }
    }
}

fn float_sum(product: f32, term: f32) -> f32 {
    product + term
}

/// Which of two places in the program's structure comes first.
fn before(a: (&Vec<(u32, u32)>, usize), b: (&Vec<(u32, u32)>, usize)) -> std::cmp::Ordering {
    let flat = |(path, at): (&Vec<(u32, u32)>, usize)| {
        path.iter().flat_map(|&(header, turn)| [header, turn]).chain([at as u32]).collect::<Vec<u32>>()
    };
    flat(a).cmp(&flat(b))
}
