//! Small pieces of surface that hang in a hole: of another depth than all that is around them, and none of it beside the hole.
//!
//! A bare wall is matched anywhere, and a few sites of it at the depth of what stands beside the object; then they are coloured by that.
//! A thing that really is there, wholly behind the object, is seen from elsewhere, and is larger than a few sites.

use crate::prepare::planes::{self, Plane, neighbours};

/// Depths of neighbours in one piece differ by at most this part.
const SAME: f64 = 0.03;
/// A piece of at most this part of its hole is taken away.
const SMALL: f64 = 0.03;
/// One plane has at least this part of what is around it.
const MOST: f64 = 0.6;

/// Takes small pieces away from a hole: their sites get the plane that is around them, and its number in `surface`.
pub fn sink(
    hole: &[bool],
    size: [usize; 2],
    planes: &[Plane],
    ray: impl Fn(usize) -> [f64; 2],
    surface: &mut [u8],
    disparity: &mut [f32],
) {
    let all = hole.iter().filter(|hole| **hole).count();
    let alike =
        |a: usize, b: usize, disparity: &[f32]| (f64::from(disparity[a]) / f64::from(disparity[b]) - 1.0).abs() <= SAME;
    let mut left: Vec<bool> = (0..hole.len()).map(|i| hole[i] && disparity[i].is_finite()).collect();
    let mut pieces = vec![];
    for first in 0..left.len() {
        let piece = planes::connected_if(first, &mut left, size, |i, j| alike(i, j, disparity));
        if !piece.is_empty() && piece.len() as f64 <= SMALL * all as f64 {
            pieces.push(piece);
        }
    }
    pieces.sort_by_key(Vec::len);
    for piece in pieces {
        let beside: Vec<(usize, usize)> = piece
            .iter()
            .flat_map(|i| neighbours(*i, size).map(move |j| (*i, j)))
            .filter(|(_, j)| !piece.contains(j))
            .collect();
        let goes_on = |(i, j): &(usize, usize)| !hole[*j] && disparity[*j].is_finite() && alike(*i, *j, disparity);
        if beside.iter().any(goes_on) {
            continue;
        }
        let on = |plane: usize| {
            let is = |(_, j): &&(usize, usize)| {
                let d = planes::on(&planes[plane], ray(*j));
                (f64::from(disparity[*j]) / d - 1.0).abs() <= SAME
            };
            beside.iter().filter(is).count()
        };
        let Some(plane) = (0..planes.len()).find(|plane| on(*plane) as f64 >= MOST * beside.len() as f64) else {
            continue;
        };
        for i in piece {
            disparity[i] = planes::on(&planes[plane], ray(i)) as f32;
            surface[i] = plane as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: [usize; 2] = [40, 30];

    fn at(i: usize) -> [usize; 2] {
        [i % SIZE[0], i / SIZE[0]]
    }

    /// A wall at depth 4 with a hole, in which something is nearer.
    fn sunk(nearer: impl Fn(usize, usize) -> bool) -> Vec<usize> {
        let place = |i: usize| (at(i)[0], at(i)[1]);
        let all = 0..SIZE[0] * SIZE[1];
        let hole: Vec<bool> =
            all.clone().map(|i| (10..30).contains(&place(i).0) && (5..25).contains(&place(i).1)).collect();
        let before: Vec<f32> =
            all.clone().map(|i| if nearer(place(i).0, place(i).1) { 1.0 / 3.0 } else { 0.25 }).collect();
        let (mut disparity, mut surface) = (before.clone(), vec![1; hole.len()]);
        let ray = |i: usize| at(i).map(|v| v as f64 / 40.0);
        sink(&hole, SIZE, &[[0.0, 0.0, 0.25]], ray, &mut surface, &mut disparity);
        let changed: Vec<usize> = all.filter(|i| disparity[*i] != before[*i]).collect();
        assert!(changed.iter().all(|i| disparity[*i] == 0.25 && surface[*i] == 0));
        changed
    }

    #[test]
    fn what_hangs_in_a_hole_is_taken_away() {
        assert_eq!(sunk(|x, y| (18..21).contains(&x) && (12..15).contains(&y)).len(), 9);
        assert_eq!(sunk(|_, _| false).len(), 0);
    }

    /// Beside the hole it goes on, and what is large is seen from elsewhere.
    #[test]
    fn what_goes_on_or_is_large_stays() {
        assert_eq!(sunk(|x, y| (27..34).contains(&x) && (12..15).contains(&y)).len(), 0);
        assert_eq!(sunk(|x, y| (14..22).contains(&x) && (12..18).contains(&y)).len(), 0);
    }
}
