//! What a program is made of.

use rspirv::spirv::GroupOperation;

/// Where a pointer leads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Space {
    /// The binding at this position in the kernel's list.
    Buffer(usize),
    Shared,
    /// An invocation's own variables.
    Private,
    Push,
    /// Built-in variables.
    Input,
}

/// What an instruction does with words.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Alu {
    Copy,
    FAdd,
    FSub,
    FMul,
    FDiv,
    FNeg,
    /// `a b + c`, rounded once.
    Fused,
    /// `a b - c`, rounded once.
    FusedMinus,
    /// `c - a b`, rounded once.
    MinusFused,
    /// `a b + c` as GLSL's `fma` may be: rounded once or twice.
    Fma,
    FMin,
    FMax,
    FAbs,
    FSign,
    Floor,
    Ceil,
    RoundEven,
    Exp,
    Log,
    Sqrt,
    InverseSqrt,
    FLess,
    FLessEqual,
    FGreater,
    FGreaterEqual,
    FEqual,
    IAdd,
    ISub,
    IMul,
    UDiv,
    UMod,
    And,
    Or,
    Xor,
    Not,
    LogicalNot,
    ShiftLeft,
    ShiftRight,
    ULess,
    ULessEqual,
    UGreater,
    UGreaterEqual,
    SLess,
    SLessEqual,
    SGreater,
    SGreaterEqual,
    Equal,
    NotEqual,
    UMin,
    UMax,
    SMin,
    SMax,
    BitCount,
    FindLeast,
    Select,
    FromSigned,
    FromUnsigned,
    ToSigned,
    ToUnsigned,
}

/// What lanes of a subgroup do together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    IAdd(GroupOperation),
    SMin,
    SMax,
    Any,
    Elect,
    Shuffle,
    ShuffleXor,
}

#[derive(Clone, Debug)]
pub enum Ins {
    Alu {
        op: Alu,
        to: u32,
        args: [u32; 3],
    },
    /// An address: `base` and each index times its stride. An index beyond its length leads nowhere.
    Chain {
        to: u32,
        base: u32,
        parts: Vec<(u32, u32, Length)>,
    },
    Load {
        space: Space,
        to: u32,
        at: u32,
        words: u32,
    },
    Store {
        space: Space,
        from: u32,
        at: u32,
        words: u32,
    },
    Atomic {
        op: Alu,
        space: Space,
        to: u32,
        at: u32,
        value: u32,
    },
    Group {
        op: Group,
        to: u32,
        args: [u32; 2],
    },
    /// Waits for the workgroup; buffers are ordered too, or shared memory alone.
    Barrier {
        buffers: bool,
    },
    Jump(usize),
    Branch {
        condition: u32,
        edges: [usize; 2],
    },
    Switch {
        selector: u32,
        default: usize,
        cases: Vec<(u32, usize)>,
    },
    Return,
}

#[derive(Clone, Copy, Debug)]
pub enum Length {
    Known(u32),
    /// That of a buffer, in elements of so many words.
    Buffer(usize, u32),
}

/// A way from a block to another.
#[derive(Clone, Debug, Default)]
pub struct Edge {
    pub target: usize,
    /// Registers from and to, all at once.
    pub moves: Vec<(u32, u32)>,
    /// Loops around the end that are around the beginning, too.
    pub keep: usize,
    /// Loops that begin: places of their headers.
    pub enter: Vec<u32>,
    /// The innermost loop that is kept begins its next turn.
    pub again: bool,
}
