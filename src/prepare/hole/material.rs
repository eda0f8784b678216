//! Materials: colours of surroundings that belong together, be it in two lights.

/// Difference of surroundings, summed over the channels, from which on they are of different materials.
pub const MATERIAL: f32 = 0.25;
/// Mean difference of the channels up to which surroundings are of one material in another light, which costs nothing: copies
/// take the light of their place.
const LIGHT: f32 = 0.05;
/// Pixels of the materials beside a hole that there must be for each pixel of it.
pub const ENOUGH: f64 = 0.25;
/// Colours among which materials are looked for at most, and the least part of them that makes one.
const SAMPLES: usize = 300;
const LEAST: f32 = 0.04;
/// What a difference of grain counts beyond one that is within a material.
const GRAIN: f32 = 4.0;
const ROUGH: f32 = 0.02;

/// The mean colour of surroundings, 0 to 1, and their grain: the deviation of the mean of the channels.
pub type Look = [f32; 4];

/// How much two surroundings, colours or [`Look`]s, are of different materials, summed over the channels.
pub fn of_another<const N: usize>(one: [f32; N], other: [f32; N]) -> f32 {
    let off: [f32; N] = std::array::from_fn(|c| one[c] - other[c]);
    let light = off[..3].iter().sum::<f32>() / 3.0;
    // Light is alike in all channels; the rest is another colour.
    let color: f32 = off[..3].iter().map(|off| (off - light).abs()).sum();
    let grain: f32 = off[3..].iter().map(|off| GRAIN * (off.abs() - ROUGH).max(0.0)).sum();
    color + 3.0 * (light.abs() - LIGHT).max(0.0) + grain
}

/// The number of the material that a colour is nearest to, of these mean colours.
pub fn nearest<const N: usize>(color: [f32; N], materials: &[[f32; N]]) -> Option<usize> {
    let apart = |k: &usize| of_another(color, materials[*k]);
    (0..materials.len()).min_by(|a, b| apart(a).total_cmp(&apart(b)))
}

/// The mean colours of the materials among the colours of surroundings, the most frequent first: the two that are least apart become one
/// until all are of different materials.
pub fn materials<const N: usize>(colors: &[[f32; N]]) -> Vec<[f32; N]> {
    let every = colors.len().div_ceil(SAMPLES).max(1);
    let mut found: Vec<([f32; N], f32)> = colors.iter().step_by(every).map(|color| (*color, 1.0)).collect();
    let all = found.len() as f32;
    // The nearest earlier one of each.
    let nearest = |found: &[([f32; N], f32)], a: usize| {
        let others = (0..a).map(|b| (of_another(found[a].0, found[b].0), b));
        others.reduce(|best, next| if next.0 < best.0 { next } else { best }).unwrap_or((f32::INFINITY, 0))
    };
    let mut near: Vec<(f32, usize)> = (0..found.len()).map(|a| nearest(&found, a)).collect();
    while let Some((apart, a)) = near.iter().enumerate().map(|(a, near)| (near.0, a)).min_by(|x, y| x.0.total_cmp(&y.0))
    {
        if apart > MATERIAL {
            break;
        }
        let b = near[a].1;
        let ((one, n), (other, m)) = (found[a], found[b]);
        found[b] = (std::array::from_fn(|c| (one[c] * n + other[c] * m) / (n + m)), n + m);
        found.remove(a);
        near.remove(a);
        for k in b..near.len() {
            if k == b || k >= a || near[k].1 == b || near[k].1 == a {
                near[k] = nearest(&found, k);
            } else {
                let apart = of_another(found[k].0, found[b].0);
                if apart < near[k].0 {
                    near[k] = (apart, b);
                }
            }
        }
    }
    found.retain(|(_, count)| *count >= LEAST * all);
    found.sort_by(|a, b| b.1.total_cmp(&a.1));
    found.into_iter().map(|(mean, _)| mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Leaves in sun and shade are one material, stone is another, and a few stray colours are none.
    #[test]
    fn one_thing_in_two_lights_is_one_material() {
        let speck = |i: usize| 0.02 * ((i * 7919) % 97) as f32 / 97.0;
        let leaves = (0..200).map(|i| [0.2, 0.4, 0.2].map(|v| v + speck(i) + 0.03 * (i % 3) as f32));
        let stone = (0..90).map(|i| [0.5, 0.7, 0.9].map(|v| v - speck(i)));
        let colors: Vec<[f32; 3]> = leaves.chain(stone).chain([[1.0, 0.0, 0.0]; 3]).collect();
        let found = materials(&colors);
        assert_eq!(found.len(), 2, "{found:?}");
        assert!(of_another(found[0], [0.24, 0.44, 0.24]) < 0.1 && of_another(found[1], [0.49, 0.69, 0.89]) < 0.1);
        assert_eq!(materials(&[]), Vec::<[f32; 3]>::new());
    }

    /// Gravel before a smooth stone of its mean colour is another material.
    #[test]
    fn grain_tells_materials_of_one_colour_apart() {
        let look = |i: usize| -> Look {
            [0.4, 0.42, 0.5, if i.is_multiple_of(2) { 0.02 } else { 0.06 } + 0.0001 * (i % 50) as f32]
        };
        let looks: Vec<Look> = (0..200).map(look).collect();
        assert_eq!(materials(&looks[..1]).len(), 1);
        assert_eq!(materials(&looks).len(), 1);
        let rougher: Vec<Look> =
            looks.iter().map(|[r, g, b, grain]| [*r, *g, *b, if *grain > 0.05 { 0.12 } else { *grain }]).collect();
        assert_eq!(materials(&rougher).len(), 2);
        assert_eq!(of_another([0.4, 0.42, 0.5], [0.4, 0.42, 0.5]), 0.0);
    }
}
