//! The structure of a function's blocks: their order, and the loops around them.

use std::collections::{HashMap, HashSet};

use rspirv::dr::Block;
use rspirv::spirv::Op;

use super::program::id;

/// The structure of a function's blocks.
pub struct Shape {
    /// Position of a label's block.
    pub index: HashMap<u32, usize>,
    /// All that are reached, a construct's merge block behind its body.
    pub order: Vec<usize>,
    /// Headers of the loops around each block, the outermost first.
    pub loops: Vec<Vec<usize>>,
    headers: HashSet<usize>,
}

impl Shape {
    pub fn of(blocks: &[Block]) -> Self {
        let label = |b: &Block| b.label.as_ref().and_then(|l| l.result_id).expect("a block has a label");
        let index: HashMap<u32, usize> = blocks.iter().enumerate().map(|(i, b)| (label(b), i)).collect();
        let mut headers = HashSet::new();
        let mut merges = vec![None; blocks.len()];
        let mut next: Vec<Vec<usize>> = vec![];
        for (at, block) in blocks.iter().enumerate() {
            let mut after = vec![];
            for i in &block.instructions {
                let target = |n: usize| index[&id(&i.operands[n])];
                match i.class.opcode {
                    Op::LoopMerge => {
                        headers.insert(at);
                        merges[at] = Some(target(0));
                        // The turn's end comes behind its body.
                        after.extend([target(0), target(1)]);
                    }
                    Op::SelectionMerge => {
                        merges[at] = Some(target(0));
                        after.push(target(0));
                    }
                    Op::Branch => after.push(target(0)),
                    Op::BranchConditional => after.extend([target(2), target(1)]),
                    Op::Switch => {
                        after.extend((1..i.operands.len()).filter(|n| *n == 1 || n % 2 == 1).map(target).rev())
                    }
                    _ => {}
                }
            }
            next.push(after);
        }
        // Blocks in the order in which a search leaves them, turned round: what is visited first comes last.
        let (mut order, mut seen) = (vec![], vec![false; blocks.len()]);
        let mut stack = vec![(0, 0)];
        seen[0] = true;
        while let Some((at, turn)) = stack.pop() {
            match next[at].get(turn) {
                Some(&to) => {
                    stack.push((at, turn + 1));
                    if !seen[to] {
                        seen[to] = true;
                        stack.push((to, 0));
                    }
                }
                None => order.push(at),
            }
        }
        order.reverse();
        // A loop's blocks are those that its header leads to without its merge block.
        let mut loops = vec![vec![]; blocks.len()];
        for &header in order.iter().filter(|at| headers.contains(at)) {
            let merge = merges[header];
            let (mut body, mut stack) = (HashSet::from([header]), vec![header]);
            while let Some(at) = stack.pop() {
                for &to in &next[at] {
                    if Some(to) != merge && body.insert(to) {
                        stack.push(to);
                    }
                }
            }
            // What comes before the header is around it: a turn of an outer loop leads there.
            let outer: Vec<usize> = loops[header].clone();
            for &at in order.iter().skip_while(|at| **at != header) {
                let within = outer.iter().all(|o| loops[at].contains(o));
                if body.contains(&at) && within {
                    loops[at].push(header);
                }
            }
        }
        Self { index, order, loops, headers }
    }

    pub fn is_header(&self, at: usize) -> bool {
        self.headers.contains(&at)
    }
}
