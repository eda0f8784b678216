//! Colours whose gradients are given (Pérez et al. 2003), by successive over-relaxation.

/// Largest number of rounds, and the factor of over-relaxation.
const ROUNDS: usize = 300;
const RELAXATION: f32 = 1.9;
/// Change of a round, 0 to 1, from which on the colours have settled: a twentieth of a level of 8 bits.
const SETTLED: f32 = 2e-4;

/// What one pixel's colour is: the mean over its neighbours of theirs and the gradient to them.
pub struct Equation {
    /// The pixel.
    pub pixel: usize,
    /// Its neighbours that have a colour.
    pub beside: Vec<usize>,
    /// Sum of the gradients: the pixel's colour less each neighbour's.
    pub target: [f32; 3],
}

impl Equation {
    /// Of a pixel without neighbours yet.
    pub fn new(pixel: usize) -> Self {
        Self { pixel, beside: vec![], target: [0.0; 3] }
    }

    /// Adds a neighbour that differs by this gradient.
    pub fn add(&mut self, neighbour: usize, gradient: [f32; 3]) {
        self.beside.push(neighbour);
        (0..3).for_each(|c| self.target[c] += gradient[c]);
    }

    /// Brings the pixel nearer to its equation and returns by how much it changed.
    fn relax(&self, rgb: &mut [[f32; 3]]) -> f32 {
        if self.beside.is_empty() {
            return 0.0;
        }
        let mut sum = self.target;
        for neighbour in &self.beside {
            (0..3).for_each(|c| sum[c] += rgb[*neighbour][c]);
        }
        let own = rgb[self.pixel];
        let step: [f32; 3] = std::array::from_fn(|c| RELAXATION * (sum[c] / self.beside.len() as f32 - own[c]));
        rgb[self.pixel] = std::array::from_fn(|c: usize| own[c] + step[c]);
        step.iter().fold(0.0, |change: f32, step: &f32| change.max(step.abs()))
    }
}

/// Solves for the colours of the equations' pixels, beginning with those that are there; all others stay.
pub fn solve(rgb: &mut [[f32; 3]], equations: &[Equation]) {
    for round in 0..ROUNDS {
        // Forth and back, so that what is known on all sides travels as fast.
        let mut largest = 0f32;
        if round % 2 == 0 {
            equations.iter().for_each(|e| largest = largest.max(e.relax(rgb)));
        } else {
            equations.iter().rev().for_each(|e| largest = largest.max(e.relax(rgb)));
        }
        if largest < SETTLED {
            break;
        }
    }
    for equation in equations {
        rgb[equation.pixel] = rgb[equation.pixel].map(|v| v.clamp(0.0, 1.0));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A row between two known ends with the gradient of a ramp that is 0.2 too low: it is raised as a whole.
    #[test]
    fn gradients_stay_and_ends_meet() {
        let mut rgb = vec![[0.0; 3]; 12];
        (rgb[0], rgb[11]) = ([0.2; 3], [0.75; 3]);
        let step = 0.05;
        let equations: Vec<Equation> = (1..11)
            .map(|i| {
                let mut equation = Equation::new(i);
                equation.add(i - 1, [step; 3]);
                equation.add(i + 1, [-step; 3]);
                equation
            })
            .collect();
        solve(&mut rgb, &equations);
        for (i, color) in rgb.iter().enumerate() {
            assert!((color[0] - 0.2 - step * i as f32).abs() < 0.01, "{i}: {color:?}");
        }
    }
}
