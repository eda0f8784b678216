//! Changes to files.

use rand::RngExt as _;
use rand_pcg::Pcg64;

/// Counts and sizes at which arithmetic breaks.
const NUMBERS: [u64; 16] = [
    0,
    1,
    2,
    7,
    255,
    256,
    65_535,
    65_536,
    0x7fff_ffff,
    0x8000_0000,
    0xffff_ffff,
    0x1_0000_0000,
    1 << 40,
    u64::MAX >> 1,
    1 << 63,
    u64::MAX,
];
const FLOATS: [f64; 10] = [0.0, -0.0, -1.0, 1e-320, 1e38, 1e39, 1e308, f64::INFINITY, f64::NEG_INFINITY, f64::NAN];
const WORDS: [&str; 24] = [
    "",
    "0",
    "-1",
    "-0.0",
    "1e999",
    "-1e999",
    "1e-400",
    "nan",
    "NaN",
    "inf",
    "null",
    "true",
    "18446744073709551615",
    "18446744073709551616",
    "4294967296",
    "2147483648",
    "\"\"",
    "\"../../a\"",
    "[]",
    "{}",
    "a",
    "\u{0}",
    "\u{feff}",
    "𝄞",
];

/// Makes inputs of seeds.
pub struct Mutator<'a> {
    rng: Pcg64,
    seeds: &'a [Vec<u8>],
    text: bool,
}

impl<'a> Mutator<'a> {
    pub fn new(name: &str, seed: u64, seeds: &'a [Vec<u8>], text: bool) -> Self {
        let stream = name.bytes().fold(seed, |sum, byte| sum.wrapping_mul(31).wrapping_add(u64::from(byte)));
        Self { rng: Pcg64::new(u128::from(stream), 17), seeds, text }
    }

    fn below(&mut self, end: usize) -> usize {
        if end == 0 { 0 } else { self.rng.random_range(0..end) }
    }

    fn pick<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.rng.random_range(0..of.len())]
    }

    /// One of the seeds with one to six changes.
    pub fn input(&mut self) -> Vec<u8> {
        let at = self.below(self.seeds.len());
        let mut bytes = self.seeds[at].clone();
        for _ in 0..=self.below(3) * self.below(3) {
            if self.text && self.below(4) != 0 { self.change_text(&mut bytes) } else { self.change(&mut bytes) }
        }
        bytes
    }

    fn change(&mut self, bytes: &mut Vec<u8>) {
        // Headers are at the beginning: half of all changes are made there.
        let reach = if self.below(2) == 0 { bytes.len().min(160) } else { bytes.len() };
        let at = self.below(reach);
        let room = bytes.len() - at;
        match self.below(12) {
            0 if room > 0 => bytes[at] ^= 1 << self.below(8),
            1 if room > 0 => bytes[at] = self.pick(&[0, 1, 0x7f, 0x80, 0xff, b' ', b'\n', b'"', b'{', b'(']),
            2 if room > 0 => bytes[at] = self.rng.random(),
            kind @ 3..=6 => {
                let width = [1, 2, 4, 8][kind - 3].min(room);
                let number = self.pick(&NUMBERS);
                let (little, big) = (number.to_le_bytes(), number.to_be_bytes());
                let new = if self.below(2) == 0 { &little[..width] } else { &big[8 - width..] };
                bytes[at..at + width].copy_from_slice(new);
            }
            7 => {
                let float = self.pick(&FLOATS);
                if room >= 8 && self.below(2) == 0 {
                    bytes[at..at + 8].copy_from_slice(&float.to_le_bytes());
                } else if room >= 4 {
                    bytes[at..at + 4].copy_from_slice(&(float as f32).to_le_bytes());
                }
            }
            8 => bytes.truncate(at),
            9 => {
                let end = at + self.below(room.min(64) + 1);
                bytes.drain(at..end);
            }
            10 => {
                let end = at + self.below(room.min(64) + 1);
                let part = bytes[at..end].to_vec();
                let to = self.below(bytes.len());
                bytes.splice(to..to, part);
            }
            _ => {
                let other = self.below(self.seeds.len());
                let from = self.below(self.seeds[other].len());
                let length = self.below(64).min(self.seeds[other].len() - from).min(room);
                bytes[at..at + length].copy_from_slice(&self.seeds[other][from..from + length]);
            }
        }
    }

    fn change_text(&mut self, bytes: &mut Vec<u8>) {
        let breaks = |byte: &u8| byte.is_ascii_whitespace() || b",:[]{}()='\"".contains(byte);
        let at = self.below(bytes.len());
        match self.below(6) {
            // A word for another.
            0..=2 => {
                let start = bytes[..at].iter().rposition(breaks).map_or(0, |i| i + 1);
                let end = bytes[at..].iter().position(breaks).map_or(bytes.len(), |i| at + i).max(start);
                let word = self.pick(&WORDS);
                bytes.splice(start..end, word.bytes());
            }
            // A line less, or one twice.
            3 => {
                let start = bytes[..at].iter().rposition(|b| *b == b'\n').map_or(0, |i| i + 1);
                let end = bytes[at..].iter().position(|b| *b == b'\n').map_or(bytes.len(), |i| at + i + 1);
                let line = bytes[start..end].to_vec();
                if self.below(2) == 0 {
                    bytes.drain(start..end);
                } else {
                    bytes.splice(start..start, line);
                }
            }
            // Something within something within something.
            4 if self.below(8) == 0 => {
                let open = self.pick(&["[", "{\"a\":", "(", "[[", "a."]);
                let many = self.pick(&[100, 1000, 20_000]);
                bytes.splice(at..at, open.repeat(many).bytes());
            }
            _ => {
                let word = self.pick(&WORDS);
                bytes.splice(at..at, word.bytes());
            }
        }
    }
}
