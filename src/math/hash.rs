//! Random numbers without a state, as `glsl/include/hash.glsl` has them.

/// pcg4d: four words to four words (Jarzynski and Olano, Hash Functions for GPU Rendering, JCGT 2020).
pub fn pcg4d(words: [u32; 4]) -> [u32; 4] {
    fn mix([x, y, z, w]: [u32; 4]) -> [u32; 4] {
        let x = x.wrapping_add(y.wrapping_mul(w));
        let y = y.wrapping_add(z.wrapping_mul(x));
        let z = z.wrapping_add(x.wrapping_mul(y));
        let w = w.wrapping_add(y.wrapping_mul(z));
        [x, y, z, w]
    }
    let words = words.map(|word| word.wrapping_mul(1_664_525).wrapping_add(1_013_904_223));
    mix(mix(words).map(|word| word ^ (word >> 16)))
}
