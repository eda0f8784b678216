//! Adam (Kingma and Ba 2015) with the second moment kept as its square root.

/// One parameter and its moments.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct State {
    /// The parameter.
    pub value: f64,
    /// First moment.
    pub first: f64,
    /// Square root of the second moment.
    pub root: f64,
}

/// What a step multiplies with; the corrections are `1 / (1 - beta1^t)` and `sqrt(1 / (1 - beta2^t))`.
#[derive(Clone, Copy, Debug)]
#[allow(missing_docs, reason = "the names of the paper")]
pub struct Factors {
    pub rate: f64,
    pub epsilon: f64,
    pub complement1: f64,
    pub root_decay: f64,
    pub root_complement: f64,
    pub correction: f64,
    pub root_correction: f64,
}

/// One step. `hypot` neither under- nor overflows where the square of a gradient would.
pub fn step(state: State, gradient: f64, f: &Factors) -> State {
    let first = state.first - f.complement1 * state.first + f.complement1 * gradient;
    let root = (state.root - f.root_decay * state.root).hypot(f.root_complement * gradient);
    let value = state.value - f.rate * (f.correction * first / (f.root_correction * root + f.epsilon));
    State { value, first, root }
}
