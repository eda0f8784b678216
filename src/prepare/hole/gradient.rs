//! Colours whose gradients are given (Pérez et al. 2003), by successive over-relaxation.

use glam::Vec3A;

/// Largest number of rounds.
const ROUNDS: usize = 300;
/// Side of the square that takes as many rounds as a hole, in sides of one that is as large: a hole may go on to the picture's border.
const LONGER: f32 = 1.25;
/// Change of a round, 0 to 1, from which on the colours have settled: a twentieth of a level of 8 bits.
const SETTLED: f32 = 2e-4;

/// The equation of one pixel's colour: the mean over its neighbours of theirs and the gradient to them.
pub struct Equation {
    pixel: u32,
    /// Neighbours of the pixel that have a colour, and how many they are.
    beside: [u32; 4],
    count: usize,
    /// Sum of the gradients: the pixel's colour less each neighbour's.
    target: [f32; 3],
}

impl Equation {
    /// Of a pixel without neighbours yet.
    pub fn new(pixel: usize) -> Self {
        Self { pixel: pixel as u32, beside: [0; 4], count: 0, target: [0.0; 3] }
    }

    /// Adds one of at most four neighbours, which differs by this gradient.
    pub fn add(&mut self, neighbour: usize, gradient: [f32; 3]) {
        self.beside[self.count] = neighbour as u32;
        self.count += 1;
        (0..3).for_each(|c| self.target[c] += gradient[c]);
    }

    /// Brings the pixel nearer to its equation and returns by how much it changed.
    fn relax(&self, rgb: &mut [Vec3A], relaxation: f32) -> f32 {
        if self.count == 0 {
            return 0.0;
        }
        let mut sum = Vec3A::from(self.target);
        self.beside[..self.count].iter().for_each(|neighbour| sum += rgb[*neighbour as usize]);
        let own = &mut rgb[self.pixel as usize];
        let step = relaxation * (sum / self.count as f32 - *own);
        *own += step;
        step.abs().max_element()
    }
}

/// Solves for the colours of the equations' pixels, beginning with those that are there; all others stay. Rows are `width` pixels
/// long.
pub fn solve(rgb: &mut [[f32; 3]], width: usize, equations: &[Equation]) {
    let mut colors: Vec<Vec3A> = rgb.iter().copied().map(Vec3A::from).collect();
    // As on a chessboard: no pixel waits for the one before it.
    let is_black = |e: &&Equation| (e.pixel as usize % width + e.pixel as usize / width) % 2 == 1;
    let (black, white): (Vec<&Equation>, Vec<&Equation>) = equations.iter().partition(is_black);
    // The best for a square (Young 1954).
    let side = 1.0 + LONGER * (equations.len() as f32).sqrt();
    let relaxation = 2.0 / (1.0 + (std::f32::consts::PI / side.max(2.0)).sin());
    for _ in 0..ROUNDS {
        let mut largest = 0f32;
        white.iter().chain(&black).for_each(|e| largest = largest.max(e.relax(&mut colors, relaxation)));
        if largest < SETTLED {
            break;
        }
    }
    for equation in equations {
        let pixel = equation.pixel as usize;
        rgb[pixel] = colors[pixel].clamp(Vec3A::ZERO, Vec3A::ONE).to_array();
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
        solve(&mut rgb, 12, &equations);
        for (i, color) in rgb.iter().enumerate() {
            assert!((color[0] - 0.2 - step * i as f32).abs() < 0.01, "{i}: {color:?}");
        }
    }
}
