//! Made objects: their shape, their texture, their light.
//!
//! An object is one unit high and stands on the plane z = 0 around the origin. Everything about it is a function of its kind
//! and the seed.

use std::f64::consts::TAU;

use glam::{DVec3, dvec3};
use rand::RngExt as _;
use rand_distr::{Distribution as _, StandardNormal};
use rand_pcg::Pcg64;

/// Kinds of objects.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// A textured box, turned by the seed.
    Box,
    /// A striped sphere.
    Sphere,
    /// A thin branching thing, such as a bare shrub.
    Branch,
}

impl Kind {
    /// The word for it.
    pub fn name(self) -> &'static str {
        match self {
            Kind::Box => "box",
            Kind::Sphere => "sphere",
            Kind::Branch => "branch",
        }
    }
}

/// Random streams, so that e.g. another texture does not move the light.
const SHAPE: u64 = 1;
const TEXTURE: u64 = 2;
const LIGHT: u64 = 3;

/// A convex part.
#[derive(Clone, Copy, Debug)]
enum Part {
    Box {
        low: DVec3,
        high: DVec3,
    },
    Sphere {
        center: DVec3,
        radius: f64,
    },
    /// A tube with round ends.
    Tube {
        from: DVec3,
        to: DVec3,
        radius: f64,
    },
}

/// Where a ray meets an object.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Parameter along the ray.
    pub at: f64,
    /// Place on the object.
    pub position: DVec3,
    /// Unit, outwards.
    pub normal: DVec3,
}

impl Part {
    /// The first of a ray's parameters above zero at which it enters the part, and the normal there.
    fn hit(&self, eye: DVec3, ray: DVec3) -> Option<(f64, DVec3)> {
        match *self {
            Part::Box { low, high } => {
                // A ray along an axis divides by zero: the infinities compare as they should.
                let (a, b) = ((low - eye) / ray, (high - eye) / ray);
                let (near, far) = (a.min(b), a.max(b));
                let t = near.max_element();
                if !(t > 0.0 && t <= far.min_element()) {
                    return None;
                }
                let axis = (0..3).find(|i| near[*i] == t)?;
                let mut normal = DVec3::ZERO;
                normal[axis] = -ray[axis].signum();
                Some((t, normal))
            }
            Part::Sphere { center, radius } => {
                let t = sphere(eye - center, ray, radius)?;
                Some((t, (eye + ray * t - center) / radius))
            }
            Part::Tube { from, to, radius } => {
                let axis = to - from;
                let (out, length) = (eye - from, axis.length_squared());
                let (along, offset) = (axis.dot(ray), axis.dot(out));
                let a = length * ray.length_squared() - along * along;
                let b = length * out.dot(ray) - offset * along;
                let c = length * (out.length_squared() - radius * radius) - offset * offset;
                let wall = (-b - (b * b - a * c).sqrt()) / a;
                // NaN (no hit, or a ray along the tube) fails the comparisons as well.
                let s = offset + wall * along;
                if wall > 0.0 && s > 0.0 && s < length {
                    let position = eye + ray * wall;
                    return Some((wall, (position - from - axis * (s / length)) / radius));
                }
                let cap = |center: DVec3| {
                    let t = sphere(eye - center, ray, radius)?;
                    Some((t, (eye + ray * t - center) / radius))
                };
                let caps = [from, to].into_iter().filter_map(cap);
                caps.min_by(|a, b| a.0.total_cmp(&b.0))
            }
        }
    }

    /// A ball around it.
    fn ball(&self) -> (DVec3, f64) {
        match *self {
            Part::Box { low, high } => (0.5 * (low + high), 0.5 * (high - low).length()),
            Part::Sphere { center, radius } => (center, radius),
            Part::Tube { from, to, radius } => (0.5 * (from + to), 0.5 * (to - from).length() + radius),
        }
    }
}

/// The first parameter above zero at which a ray enters a sphere around the origin.
fn sphere(eye: DVec3, ray: DVec3, radius: f64) -> Option<f64> {
    let (a, b, c) = (ray.length_squared(), eye.dot(ray), eye.length_squared() - radius * radius);
    let t = (-b - (b * b - a * c).sqrt()) / a;
    (t > 0.0).then_some(t)
}

/// One plane wave of a solid texture.
#[derive(Clone, Debug)]
struct Wave {
    direction: DVec3,
    phase: f64,
    amplitude: DVec3,
}

/// The light on an object: one lamp that is not a point, and what comes from everywhere.
#[derive(Clone, Debug)]
pub struct Light {
    /// Towards the lamp, in the object's axes.
    pub direction: DVec3,
    /// Share of the surface's brightness that the lamp gives, 0 to 1: a shadow's darkest ratio is one less this.
    pub share: f64,
    /// Directions towards places of the lamp.
    rays: Vec<DVec3>,
}

/// Tangent of half the angle that the lamp is seen under.
const LAMP: f64 = 0.07;
/// Heights that a place is lowered by before the lamp is looked for.
const BELOW: f64 = 1e-3;
/// Places of the lamp.
const RAYS: usize = 64;

impl Light {
    fn new(seed: u64) -> Self {
        let mut rng = Pcg64::new(seed.into(), LIGHT.into());
        let azimuth = rng.random_range(0.0..TAU);
        let elevation = rng.random_range(42f64..62.0).to_radians();
        let direction = dvec3(azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin());
        let (u, v) = direction.any_orthonormal_pair();
        // A sunflower's seeds cover the disc evenly.
        let place = |i: usize| {
            let (radius, angle) = (((i as f64 + 0.5) / RAYS as f64).sqrt() * LAMP, i as f64 * 2.399_963_229_728_653);
            (direction + radius * (angle.cos() * u + angle.sin() * v)).normalize()
        };
        Self { direction, share: rng.random_range(0.42..0.58), rays: (0..RAYS).map(place).collect() }
    }
}

/// A made object.
#[derive(Clone, Debug)]
pub struct Object {
    parts: Vec<Part>,
    /// A ball around each part, and one around all.
    balls: Vec<(DVec3, f64)>,
    ball: (DVec3, f64),
    kind: Kind,
    base: DVec3,
    second: DVec3,
    waves: Vec<Wave>,
    /// The light that it stands in.
    pub light: Light,
}

impl Object {
    /// The object of a kind and a seed.
    pub fn new(kind: Kind, seed: u64) -> Self {
        let mut rng = Pcg64::new(seed.into(), SHAPE.into());
        let parts = match kind {
            Kind::Box => {
                let [x, y] = [rng.random_range(0.28..0.45), rng.random_range(0.22..0.4)];
                vec![Part::Box { low: dvec3(-x, -y, 0.0), high: dvec3(x, y, 1.0) }]
            }
            Kind::Sphere => vec![Part::Sphere { center: dvec3(0.0, 0.0, 0.5), radius: 0.5 }],
            Kind::Branch => branches(&mut rng),
        };
        let balls: Vec<_> = parts.iter().map(Part::ball).collect();
        let middle = dvec3(0.0, 0.0, 0.5);
        let reach = balls.iter().map(|(center, radius)| (*center - middle).length() + radius).fold(0.0, f64::max);
        let mut rng = Pcg64::new(seed.into(), TEXTURE.into());
        let hue = rng.random_range(0.0..1.0);
        let (base, second) = match kind {
            Kind::Branch => (hsv(0.03 + 0.08 * hue, 0.55, 0.5), hsv(0.06 + 0.08 * hue, 0.5, 0.33)),
            _ => (hsv(hue, 0.7, 0.82), hsv(hue + rng.random_range(0.3..0.7), 0.45, 0.62)),
        };
        let wave = |i: u32, rng: &mut Pcg64| {
            let mut normal = || -> f64 { StandardNormal.sample(rng) };
            let length = 0.6 * 0.12f64.powf(f64::from(i) / 9.0);
            let direction = dvec3(normal(), normal(), normal()).normalize() * (TAU / length);
            let tint = DVec3::ONE + 0.3 * dvec3(normal(), normal(), normal());
            Wave { direction, phase: rng.random_range(0.0..TAU), amplitude: 0.07 * length.powf(0.25) * tint }
        };
        let waves = (0..10).map(|i| wave(i, &mut rng)).collect();
        Self { parts, balls, ball: (middle, reach), kind, base, second, waves, light: Light::new(seed) }
    }

    /// Centre and radius of a ball around it.
    pub fn ball(&self) -> (DVec3, f64) {
        self.ball
    }

    /// Where a ray first meets it above the ground.
    pub fn hit(&self, eye: DVec3, ray: DVec3) -> Option<Hit> {
        if !near(self.ball, eye, ray, 0.0) {
            return None;
        }
        let hits = self.parts.iter().zip(&self.balls).filter(|(_, ball)| near(**ball, eye, ray, 0.0));
        let (at, normal) = hits.filter_map(|(part, _)| part.hit(eye, ray)).min_by(|a, b| a.0.total_cmp(&b.0))?;
        let position = eye + ray * at;
        // What would be below the ground is hidden by it.
        (position.z >= -1e-9).then_some(Hit { at, position, normal })
    }

    /// Whether a place is so far from its shadow that nothing of the lamp is hidden there.
    pub fn hides_nothing(&self, place: DVec3) -> bool {
        !near(self.ball, place, self.light.direction, LAMP)
    }

    /// The share of the lamp that it hides from a place, 0 to 1.
    pub fn hides(&self, place: DVec3) -> f64 {
        if self.hides_nothing(place) {
            return 0.0;
        }
        let toward = self.light.direction;
        // A place on the ground is below what stands on it.
        let place = place - BELOW * DVec3::Z;
        let parts: Vec<&Part> = (self.parts.iter().zip(&self.balls))
            .filter(|(_, ball)| near(**ball, place, toward, LAMP))
            .map(|(part, _)| part)
            .collect();
        if parts.is_empty() {
            return 0.0;
        }
        let hidden = self.light.rays.iter().filter(|ray| parts.iter().any(|part| part.hit(place, **ray).is_some()));
        hidden.count() as f64 / self.light.rays.len() as f64
    }

    /// Brightness of its surface, 0 to 1 by channel, in the object's own light.
    pub fn color(&self, hit: &Hit) -> DVec3 {
        let (p, n) = (hit.position, hit.normal);
        let waves: DVec3 = self.waves.iter().map(|w| w.amplitude * (w.direction.dot(p) + w.phase).sin()).sum();
        let mix = match self.kind {
            // A frame along the edges and a band around the middle.
            Kind::Box => {
                let Some(Part::Box { low, high }) = self.parts.first() else { return self.base };
                let inner = (p - *low).min(*high - p).to_array();
                let mut sides: Vec<f64> = (0..3).filter(|i| n[*i].abs() < 0.5).map(|i| inner[i]).collect();
                sides.sort_unstable_by(f64::total_cmp);
                let edge = soft((0.05 - sides.first().copied().unwrap_or(1.0)) / 0.01);
                edge.max(soft((0.09 - (p.z - 0.62).abs()) / 0.01))
            }
            Kind::Sphere => {
                let around = p.y.atan2(p.x) / TAU;
                soft(((8.0 * TAU * (around + 0.6 * p.z)).sin() - 0.1) / 0.12)
            }
            Kind::Branch => soft((TAU * 9.0 * p.z).sin()),
        };
        let surface = self.base.lerp(self.second, mix) * (0.95 + waves);
        // Near the ground less comes from around.
        let around =
            (1.0 - self.light.share) * (0.72 + 0.28 * (0.5 + 0.5 * n.z)) * (0.78 + 0.22 * (p.z / 0.25).min(1.0));
        let lamp = self.light.share * 1.35 * n.dot(self.light.direction).max(0.0);
        (surface * (around + lamp)).clamp(DVec3::ZERO, DVec3::ONE)
    }
}

/// Whether a ray, opened into a cone of this tangent, can meet a ball ahead.
fn near((center, radius): (DVec3, f64), eye: DVec3, ray: DVec3, tangent: f64) -> bool {
    let to = center - eye;
    let along = to.dot(ray) / ray.length();
    let across = to.length_squared() - along * along;
    let reach = radius * (1.0 + tangent) + tangent * along.max(0.0);
    along > -radius && across <= reach * reach
}

/// 0 to 1 around 0, within about one.
fn soft(x: f64) -> f64 {
    let x = (0.5 + 0.5 * x).clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

fn hsv(hue: f64, saturation: f64, value: f64) -> DVec3 {
    let channel = |offset: f64| ((6.0 * (hue + offset).rem_euclid(1.0) - 3.0).abs() - 1.0).clamp(0.0, 1.0);
    let full = dvec3(channel(0.0), channel(2.0 / 3.0), channel(1.0 / 3.0));
    value * DVec3::ONE.lerp(full, saturation)
}

/// A trunk that divides again and again, one unit high.
fn branches(rng: &mut Pcg64) -> Vec<Part> {
    struct Tip {
        at: DVec3,
        toward: DVec3,
        length: f64,
        radius: f64,
    }
    let lean = dvec3(rng.random_range(-0.12..0.12), rng.random_range(-0.12..0.12), 1.0).normalize();
    let mut tips = vec![Tip { at: DVec3::ZERO, toward: lean, length: 0.34, radius: 0.026 }];
    let mut tubes: Vec<(DVec3, DVec3, f64)> = vec![];
    for level in 0..5 {
        let mut next = vec![];
        for tip in tips {
            let to = tip.at + tip.toward * tip.length;
            tubes.push((tip.at, to, tip.radius));
            let (u, v) = tip.toward.any_orthonormal_pair();
            let count = if level == 0 { 3 } else { 2 };
            let turn = rng.random_range(0.0..TAU);
            for i in 0..count {
                let around = turn + TAU * f64::from(i) / f64::from(count) + rng.random_range(-0.4..0.4);
                let tilt: f64 = rng.random_range(0.35..0.75);
                let side = around.cos() * u + around.sin() * v;
                // Twigs bend upwards.
                let toward = (tilt.cos() * tip.toward + tilt.sin() * side + 0.15 * DVec3::Z).normalize();
                let length = tip.length * rng.random_range(0.68..0.86);
                next.push(Tip { at: to, toward, length, radius: tip.radius * 0.68 });
            }
        }
        tips = next;
    }
    let top = tubes.iter().map(|(_, to, radius)| to.z + radius).fold(0.0, f64::max);
    tubes
        .iter()
        .map(|(from, to, radius)| Part::Tube { from: *from / top, to: *to / top, radius: radius / top })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Marching along rays finds the surface where the formulas do: the nearest place inside a part.
    #[test]
    fn rays_meet_parts_where_they_begin() {
        let mut rng = Pcg64::new(1, 1);
        let parts = [
            Part::Box { low: dvec3(-0.3, -0.2, 0.0), high: dvec3(0.3, 0.2, 1.0) },
            Part::Sphere { center: dvec3(0.1, 0.0, 0.5), radius: 0.4 },
            Part::Tube { from: dvec3(-0.2, 0.1, 0.1), to: dvec3(0.3, 0.0, 0.8), radius: 0.15 },
        ];
        let inside = |part: &Part, p: DVec3| match *part {
            Part::Box { low, high } => p.cmpge(low).all() && p.cmple(high).all(),
            Part::Sphere { center, radius } => (p - center).length() <= radius,
            Part::Tube { from, to, radius } => {
                let axis = to - from;
                let s = ((p - from).dot(axis) / axis.length_squared()).clamp(0.0, 1.0);
                (p - from - axis * s).length() <= radius
            }
        };
        for part in &parts {
            let (mut met, mut missed) = (0, 0);
            for _ in 0..300 {
                let mut draw = || rng.random_range(-1.0..1.0);
                let eye = dvec3(draw(), draw(), draw()).normalize() * 3.0;
                let ray = (dvec3(0.6 * draw(), 0.6 * draw(), 0.5 + 0.6 * draw()) - eye) / 3.0;
                let marched = (0..6000).map(|i| f64::from(i) * 0.001).find(|t| inside(part, eye + ray * *t));
                match (marched, part.hit(eye, ray)) {
                    (Some(marched), Some((at, normal))) => {
                        met += 1;
                        assert!(at <= marched + 1e-9 && marched - at < 0.0011, "{part:?}: {at} and {marched}");
                        assert!((normal.length() - 1.0).abs() < 1e-9 && normal.dot(ray) < 1e-6);
                    }
                    (None, None) => missed += 1,
                    // A corner that is cut for less than a step.
                    (None, Some((at, _))) => assert!(inside(part, eye + ray * (at + 1e-7)), "{part:?}"),
                    (Some(_), None) => panic!("{part:?} is missed"),
                }
            }
            assert!(met > 30 && missed > 30, "{part:?}: {met} met, {missed} missed");
        }
    }

    #[test]
    fn objects_stand_on_the_ground_and_are_one_unit_high() {
        for kind in [Kind::Box, Kind::Sphere, Kind::Branch] {
            for seed in 0..5 {
                let object = Object::new(kind, seed);
                let (mut high, mut low, mut hits) = (0.0_f64, 1.0_f64, 0);
                for i in 0..300 {
                    for j in 0..300 {
                        let eye = dvec3(-5.0, f64::from(i) / 100.0 - 1.5, f64::from(j) / 200.0 - 0.2 + 1e-6);
                        let Some(hit) = object.hit(eye, DVec3::X) else { continue };
                        hits += 1;
                        (high, low) = (high.max(hit.position.z), low.min(hit.position.z));
                        let color = object.color(&hit);
                        assert!(color.min_element() >= 0.0 && color.max_element() <= 1.0);
                    }
                }
                assert!(hits > 500, "{kind:?} {seed}: {hits}");
                assert!(high > 0.98 && high <= 1.0 && (0.0..0.02).contains(&low), "{kind:?} {seed}: {low} to {high}");
            }
        }
    }

    /// A sphere's shadow: whole below it, none far off, and soft between.
    #[test]
    fn a_shadow_is_whole_within_and_soft_at_its_border() {
        let object = Object::new(Kind::Sphere, 4);
        let away = -object.light.direction * dvec3(1.0, 1.0, 0.0) / object.light.direction.z;
        // The centre's shadow.
        let middle = away * 0.5;
        assert_eq!(object.hides(middle), 1.0);
        assert_eq!(object.hides(middle + away.normalize() * 2.0), 0.0);
        let side = dvec3(-away.y, away.x, 0.0).normalize();
        let profile: Vec<f64> = (0..100).map(|i| object.hides(middle + side * (0.01 * f64::from(i)))).collect();
        assert!(profile.windows(2).all(|p| p[1] <= p[0] + 1e-9), "{profile:?}");
        let soft = profile.iter().filter(|h| **h > 0.0 && **h < 1.0).count();
        // The lamp's disc, 0.07 on each side, from 0.5 / sin(elevation) away.
        assert!((5..=14).contains(&soft), "{soft}: {profile:?}");
        // Nothing hides the lamp from above.
        assert_eq!(object.hides(dvec3(0.0, 0.0, 1.2)), 0.0);
    }

    #[test]
    fn the_seed_says_everything() {
        let look = |seed| {
            let object = Object::new(Kind::Branch, seed);
            let hit = Hit { at: 1.0, position: dvec3(0.01, 0.02, 0.1), normal: DVec3::X };
            (object.ball(), object.color(&hit), object.light.direction)
        };
        assert_eq!(look(3), look(3));
        assert_ne!(look(3), look(4));
    }
}
