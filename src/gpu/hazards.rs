//! Which accesses must wait for which: the one place barriers come from.

use std::collections::HashMap;
use std::fmt;

use super::kernel::Access;

/// A buffer's identity on the device.
pub(super) type Id = u64;

/// One line of a recorded schedule.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Entry {
    /// A pass and what it touches.
    Pass {
        /// `folder/stem` of the kernel, or `fill`, `copy`.
        name: &'static str,
        /// The stage it belongs to.
        stage: &'static str,
        /// Buffer name and access, in binding order.
        accesses: Vec<(&'static str, Access)>,
    },
    /// A barrier and the hazards that demand it.
    Barrier {
        /// For example `read after write: mean (render/project -> render/bin_count)`.
        reasons: Vec<String>,
    },
}

/// What a recorder recorded, in order. Its text form is golden-tested.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Schedule {
    /// Passes and barriers.
    pub entries: Vec<Entry>,
}

impl Schedule {
    /// Number of passes.
    pub fn passes(&self) -> usize {
        self.entries.iter().filter(|e| matches!(e, Entry::Pass { .. })).count()
    }
    /// Number of barriers.
    pub fn barriers(&self) -> usize {
        self.entries.len() - self.passes()
    }
}

impl fmt::Display for Schedule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for entry in &self.entries {
            match entry {
                Entry::Pass { name, accesses, .. } => {
                    write!(f, "{name}")?;
                    for (buffer, access) in accesses {
                        let mark = match access {
                            Access::Read => "<",
                            Access::Write => ">",
                            Access::ReadWrite => "<>",
                        };
                        write!(f, "  {mark}{buffer}")?;
                    }
                    writeln!(f)?;
                }
                Entry::Barrier { reasons } => writeln!(f, "    barrier: {}", reasons.join("; "))?,
            }
        }
        Ok(())
    }
}

/// Accesses since the last barrier.
#[derive(Default)]
pub(super) struct Hazards {
    read: Vec<(Id, &'static str)>,
    written: Vec<(Id, &'static str)>,
}

impl Hazards {
    /// The reasons why a pass with these accesses must wait; empty when it need not. Starts a new window if it must.
    pub(super) fn enter(
        &mut self,
        pass: &'static str,
        accesses: &[(Id, &'static str, Access)],
        always: bool,
    ) -> Vec<String> {
        let mut reasons = vec![];
        for &(id, buffer, access) in accesses {
            let before = |list: &[(Id, &'static str)]| list.iter().rev().find(|(b, _)| *b == id).map(|(_, p)| *p);
            let (written, read) = (before(&self.written), before(&self.read));
            let reason = match (access, written, read) {
                (Access::Read | Access::ReadWrite, Some(by), _) => Some(("read after write", by)),
                (Access::Write, Some(by), _) => Some(("write after write", by)),
                (Access::Write | Access::ReadWrite, None, Some(by)) => Some(("write after read", by)),
                _ => None,
            };
            if let Some((kind, by)) = reason {
                reasons.push(format!("{kind}: {buffer} ({by} -> {pass})"));
            }
        }
        if reasons.is_empty() && always && !(self.read.is_empty() && self.written.is_empty()) {
            reasons.push("serialized".into());
        }
        if !reasons.is_empty() {
            *self = Self::default();
        }
        for &(id, _, access) in accesses {
            if access.reads() {
                self.read.push((id, pass));
            }
            if access.writes() {
                self.written.push((id, pass));
            }
        }
        reasons
    }
}

/// For each pass, by its accesses, how many barriers must at least come before it: one more than before any earlier pass for
/// which it has to wait.
pub(super) fn waves<'a>(passes: impl Iterator<Item = &'a [(Id, &'static str, Access)]>) -> Vec<u32> {
    /// The first wave for those that wait for a buffer's last write, and for its last read.
    #[derive(Default)]
    struct After {
        write: u32,
        read: u32,
    }
    let mut buffers: HashMap<Id, After> = HashMap::new();
    let wave = |accesses: &'a [(Id, &'static str, Access)]| {
        let first = |(id, _, access): &(Id, &'static str, Access)| {
            let after = buffers.entry(*id).or_default();
            if access.writes() { after.write.max(after.read) } else { after.write }
        };
        let wave = accesses.iter().map(first).max().unwrap_or(0);
        for (id, _, access) in accesses {
            let after = buffers.entry(*id).or_default();
            if access.writes() {
                after.write = after.write.max(wave + 1);
            }
            if access.reads() {
                after.read = after.read.max(wave + 1);
            }
        }
        wave
    };
    passes.map(wave).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn enter(hazards: &mut Hazards, accesses: &[(Id, &'static str, Access)]) -> Vec<String> {
        hazards.enter("pass", accesses, false)
    }

    #[test]
    fn a_barrier_comes_exactly_where_a_hazard_demands_one() {
        let mut h = Hazards::default();
        let read = [(1, "a", Access::Read)];
        let write = [(1, "a", Access::Write)];
        assert!(enter(&mut h, &read).is_empty());
        assert!(enter(&mut h, &read).is_empty(), "two readers need no order");
        assert_eq!(enter(&mut h, &write), ["write after read: a (pass -> pass)"]);
        assert_eq!(enter(&mut h, &write), ["write after write: a (pass -> pass)"]);
        assert_eq!(enter(&mut h, &read), ["read after write: a (pass -> pass)"]);
        assert!(enter(&mut h, &[(2, "b", Access::ReadWrite)]).is_empty(), "another buffer is free");
        assert_eq!(enter(&mut h, &[(2, "b", Access::ReadWrite)]), ["read after write: b (pass -> pass)"]);
        assert!(enter(&mut h, &read).is_empty(), "the barrier before covered the older write too");
    }

    #[test]
    fn waves_keep_the_order_of_whoever_touches_the_same() {
        let [a, b] = [|access| (1, "a", access), |access| (2, "b", access)];
        let passes = [
            vec![a(Access::Write)],
            vec![a(Access::Read), b(Access::Write)],
            vec![a(Access::Read)],
            vec![b(Access::Read)],
            vec![a(Access::ReadWrite)],
            vec![(3, "c", Access::Write)],
            vec![a(Access::Read), b(Access::ReadWrite)],
            vec![],
        ];
        assert_eq!(waves(passes.iter().map(Vec::as_slice)), [0, 1, 1, 2, 2, 0, 3, 0]);
    }

    #[test]
    fn serialize_adds_one_between_any_two_passes() {
        let mut h = Hazards::default();
        assert!(h.enter("a", &[(1, "x", Access::Read)], true).is_empty());
        assert_eq!(h.enter("b", &[(2, "y", Access::Read)], true), ["serialized"]);
    }
}
