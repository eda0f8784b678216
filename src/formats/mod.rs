//! Files of Gaussians that viewers read: their bytes, there and back. Why bytes are refused is said in words that follow the
//! file's name.

pub mod gltf;
pub mod ply;
pub mod sog;
pub mod splat;
pub mod spz;

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;
    use crate::export::tests::cloud;
    use crate::math::harmonics::coefficients;
    use crate::model::gaussians::{Cloud, sigmoid};

    /// Angle between two rotations, radians.
    fn angle(a: [f32; 4], b: [f32; 4]) -> f64 {
        let dot: f64 = a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(b)).sum();
        2.0 * (1.0 - dot * dot).max(0.0).sqrt().asin()
    }

    /// Largest distance of two arrays' values.
    fn distance(a: &[[f32; 3]], b: &[[f32; 3]]) -> f32 {
        assert_eq!(a.len(), b.len());
        a.as_flattened().iter().zip(b.as_flattened()).fold(0.0, |m, (a, b)| m.max((a - b).abs()))
    }

    #[test]
    fn a_ply_keeps_every_bit() {
        for degree in 0..=3 {
            let cloud = cloud(37, degree);
            let bytes = ply::encode(&cloud);
            assert_eq!(ply::decode(&bytes).expect("our own file"), cloud);
            let text = String::from_utf8_lossy(&bytes[..2000]);
            assert_eq!(text.matches("property float ").count(), 62);
            assert!(!text.contains("comment"), "some readers take no comments");
            assert!(ply::decode(&bytes[..bytes.len() - 1]).is_err(), "cut off");
            let tagged = Cloud { antialiased: true, ..cloud };
            assert_eq!(ply::decode(&ply::encode(&tagged)).expect("our own file"), tagged);
        }
        assert!(ply::decode(b"ply\n").is_err());
    }

    /// Float32 exponentials and logarithms, and a logit that is flat where the opacity is near 1.
    #[test]
    fn a_glb_keeps_what_float32_keeps() {
        for degree in 0..=3 {
            let cloud = cloud(41, degree);
            let bytes = gltf::encode(&cloud).expect("it is small");
            assert_eq!(bytes.len() % 4, 0);
            let back = gltf::decode(&bytes).expect("our own file");
            assert_eq!((&back.position, &back.harmonics, back.degree), (&cloud.position, &cloud.harmonics, degree));
            assert!(distance(&back.log_scale, &cloud.log_scale) < 1e-5);
            assert!(back.rotation == cloud.rotation, "turning there and back moves components and signs");
            for (a, b) in back.logit.iter().zip(&cloud.logit) {
                assert!((sigmoid(*a) - sigmoid(*b)).abs() < 1e-6, "{a} {b}");
            }
            assert!(gltf::decode(&bytes[..bytes.len() - 4]).is_err(), "cut off");
        }
    }

    /// The turn into glTF's axes is a rotation: the Gaussians' covariances turn with their positions.
    #[test]
    fn a_glb_stands_the_other_way_up() {
        let mut turned = cloud(9, 0);
        let bytes = gltf::encode(&turned).expect("it is small");
        turned.turn(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));
        // What a reader sees that knows nothing of the turn.
        let as_written = {
            let mut back = gltf::decode(&bytes).expect("our own file");
            for (p, q) in back.position.iter_mut().zip(&mut back.rotation) {
                *p = [p[0], -p[1], -p[2]];
                *q = [-q[1], q[0], -q[3], q[2]];
            }
            back
        };
        assert!(distance(&as_written.position, &turned.position) == 0.0);
        for (a, b) in as_written.rotation.iter().zip(&turned.rotation) {
            assert!(angle(*a, *b) < 1e-3, "{a:?} {b:?}");
        }
    }

    /// The angle that a rotation is off by whose x y z are rounded to 255 steps and whose w follows from them.
    fn rounded(w: f32) -> f64 {
        let d = 3f64.sqrt() / 255.0;
        // The square of x y z is off by as much, and so is that of w.
        let square = 2.0 * d + d * d;
        let off = square.sqrt().min(square / f64::from(w).abs());
        // Twice the quaternions' angle, which is the chord's arc.
        4.0 * (0.5 * d.hypot(off)).asin() + 1e-3
    }

    /// What a byte or 24 bits round, and no more.
    #[test]
    fn an_spz_keeps_what_its_bits_keep() {
        for (degree, version) in (0..=3).flat_map(|d| [(d, spz::Version::Two), (d, spz::Version::Three)]) {
            let cloud = Cloud { antialiased: degree % 2 == 1, ..cloud(53, degree) };
            let bytes = spz::encode(&cloud, version).expect("it fits");
            let back = spz::decode(&bytes).expect("our own file");
            // 6 units leave 20 fractional bits of 24 signed ones.
            assert!(distance(&back.position, &cloud.position) <= 0.5 / f32::from(1u16 << 10).powi(2));
            assert!(distance(&back.log_scale, &cloud.log_scale) <= 0.5 / 16.0 + 1e-6);
            let each = coefficients(degree);
            for i in 0..cloud.len() {
                // 1.77 units of the coefficient of degree 0 on either side in 255 steps.
                let (a, b) = (&back.harmonics[i * each..][..each], &cloud.harmonics[i * each..][..each]);
                assert!(distance(&a[..1], &b[..1]) <= 0.5 / 255.0 / 0.15 + 1e-6);
                assert!(distance(&a[1..], &b[1..]) <= 0.5 / 128.0 + 1e-6);
                assert!((sigmoid(back.logit[i]) - sigmoid(cloud.logit[i])).abs() <= 0.5 / 255.0 + 1.1e-4);
                // Three components of half a step of 1.38e-3 each, and the fourth that follows from them.
                let most = if version == spz::Version::Two { rounded(cloud.rotation[i][0]) } else { 6e-3 };
                assert!(angle(back.rotation[i], cloud.rotation[i]) < most);
            }
            assert_eq!(back.antialiased, cloud.antialiased);
            assert_eq!(&bytes[..2], &[0x1f, 0x8b], "gzip");
            assert!(spz::decode(&bytes[..bytes.len() / 2]).is_err(), "cut off");
        }
    }

    /// The largest distance within a part of a list that goes evenly from the least to the most value in 127 steps.
    fn step(values: &[f32]) -> f32 {
        let (low, high) = values.iter().fold((f32::MAX, f32::MIN), |(low, high), v| (low.min(*v), high.max(*v)));
        (high - low) / 127.0
    }

    /// For each of some Gaussians the nearest of others, which stand in another order.
    fn nearest(to: &Cloud, of: &Cloud) -> Vec<usize> {
        let square = |a: [f32; 3], b: [f32; 3]| (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f32>();
        let one = |p: &[f32; 3]| {
            let closer = |a: &usize, b: &usize| square(of.position[*a], *p).total_cmp(&square(of.position[*b], *p));
            (0..of.len()).min_by(closer).expect("it is not empty")
        };
        to.position.iter().map(one).collect()
    }

    #[test]
    fn a_sog_keeps_what_its_bytes_keep() {
        for degree in 0..=3 {
            let cloud = Cloud { antialiased: degree == 2, ..cloud(67, degree) };
            let bytes = sog::encode(&cloud).expect("it is small");
            let back = sog::decode(&bytes).expect("our own file");
            assert_eq!((back.len(), back.degree, back.antialiased), (cloud.len(), degree, cloud.antialiased));
            let order = nearest(&cloud, &back);
            assert_eq!(order.iter().collect::<std::collections::HashSet<_>>().len(), cloud.len());
            let each = coefficients(degree);
            let firsts: Vec<f32> = cloud.harmonics.iter().step_by(each).flatten().copied().collect();
            let higher: Vec<f32> =
                (0..cloud.len()).flat_map(|i| cloud.harmonics_of(i)[1..].as_flattened().to_vec()).collect();
            // Half a step of a list, and float32's rounding.
            let half = |values: &[f32]| 0.5 * step(values) + 1e-6;
            let (scales, firsts) = (half(cloud.log_scale.as_flattened()), half(&firsts));
            let higher = if degree == 0 { 0.0 } else { half(&higher) };
            for (i, j) in order.into_iter().enumerate() {
                for c in 0..3 {
                    let v = cloud.position[i][c];
                    // Half of 65,535 steps of ln(1 + |v|), of which all are within 6 units, and the slope at v.
                    let most = 0.5 * 2.0 * 7f32.ln() / 65535.0 * (1.001 + v.abs()) + 1e-6;
                    assert!((back.position[j][c] - v).abs() <= most, "{v}");
                }
                assert!(distance(&[back.log_scale[j]], &[cloud.log_scale[i]]) <= scales);
                let (a, b) = (back.harmonics_of(j), cloud.harmonics_of(i));
                assert!(distance(&a[..1], &b[..1]) <= firsts);
                assert!(distance(&a[1..], &b[1..]) <= higher);
                assert!((sigmoid(back.logit[j]) - sigmoid(cloud.logit[i])).abs() <= 0.5 / 255.0 + 1.1e-4);
                // Three components of half of 255 steps of sqrt 2 each, e; the largest, at least 1/2, is off by 3 e, the
                // quaternion by sqrt 12 e, and the rotation by twice that.
                assert!(angle(back.rotation[j], cloud.rotation[i]) < 2.0 * 12f64.sqrt() * 2.78e-3 + 1e-3);
            }
            (0..bytes.len()).step_by(7).for_each(|end| assert!(sog::decode(&bytes[..end]).is_err(), "{end}"));
        }
    }

    /// Positions in one plane, or one alone, have no step to divide by.
    #[test]
    fn a_sog_of_one_place_is_there() {
        let mut cloud = cloud(5, 1);
        cloud.position.iter_mut().for_each(|p| *p = [0.5, -3.0, p[2]]);
        cloud.retain(&[true, false, true, false, false]);
        let back = sog::decode(&sog::encode(&cloud).expect("two")).expect("our own file");
        assert!(back.position.iter().all(|p| (p[0] - 0.5).abs() < 1e-6 && (p[1] + 3.0).abs() < 1e-6));
        assert!(sog::encode(&Cloud::default()).is_err());
        cloud.logit[0] = f32::NAN;
        assert!(sog::encode(&cloud).is_err());
    }

    #[test]
    fn a_splat_keeps_what_its_bytes_keep() {
        let cloud = cloud(31, 2);
        let bytes = splat::encode(&cloud);
        assert_eq!(bytes.len(), 32 * cloud.len());
        let back = splat::decode(&bytes).expect("our own file");
        assert_eq!((&back.position, back.degree), (&cloud.position, 0));
        assert!(distance(&back.log_scale, &cloud.log_scale) < 1e-5);
        for i in 0..cloud.len() {
            // Half of 255 steps of a displayed colour.
            let own = cloud.harmonics_of(i)[0].map(|v| v.clamp(-0.5 / 0.2821, 0.5 / 0.2821));
            assert!(distance(&[back.harmonics[i]], &[own]) <= 0.5 / 255.0 / 0.282 + 1e-4);
            assert!((sigmoid(back.logit[i]) - sigmoid(cloud.logit[i])).abs() <= 0.5 / 255.0 + 1.1e-4);
            // Four components of half a step of 1/128, a whole one where 1 is cut off; twice that for the rotation.
            assert!(angle(back.rotation[i], cloud.rotation[i]) < 2.0 * 2.0 / 128.0);
        }
        assert!(splat::decode(&bytes[1..]).is_err());
    }

    #[test]
    fn an_spz_takes_any_unit() {
        for unit in [1e-3f32, 1.0, 1e3, 1e6] {
            let mut cloud = cloud(50, 0);
            cloud.position.iter_mut().for_each(|p| *p = p.map(|v| v * unit));
            let back = spz::decode(&spz::encode(&cloud, spz::Version::Three).expect("it fits")).expect("our own file");
            // 22 bits of the farthest coordinate, or the 24 fractional ones that JavaScript's shifts allow.
            let step = (12.0 * unit / (1 << 22) as f32).max(0.6 / (1 << 24) as f32);
            assert!(distance(&back.position, &cloud.position) <= step, "{unit}");
        }
        let mut far = cloud(2, 0);
        far.position[1][2] = 1e7;
        let error = spz::encode(&far, spz::Version::Three).expect_err("24 bits do not hold it").to_string();
        assert!(error.contains("--formats"), "{error}");
    }
}
