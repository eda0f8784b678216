//! What the object stands on, or leans on, goes on under it.
//!
//! A plane that the object rises from and touches is one: its points lie on one side of it, and some lie next to it. Where
//! the object's points come down to when they are dropped onto the plane, the plane is, and hides what is behind it.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::flat::{Common, LEAST, Measured};
use super::surface::{Sight, Sights};
use crate::prepare::planes::{self, Plane};
use crate::statistics::{median, quantile};

/// Least part of what is known around a hole that lies on a plane, and on none before it, for the object to stand on that.
const SHOWN: f64 = 0.05;
/// Fewest points of the object that tell what it stands on.
const FEWEST: usize = 30;
/// Points higher than this part of the object's height are clear of the plane; lower ones touch it.
const CLEAR: f64 = 0.15;
/// Points within this part of the object's height of the plane are the plane's.
const ON_IT: f64 = 0.08;
/// Points lower than this part of the object's height are above where it stands: what it stands on is known to a few parts of it.
const FOOT: f64 = 0.25;
/// Least part of the points that is clear of the plane, most that lies behind it, and least that touches it.
const RISES: f64 = 0.5;
const BEHIND: f64 = 0.1;
const TOUCHES: f64 = 0.02;
/// Points of the object in all views that tell where it stands, at most.
const POINTS: usize = 20_000;
/// Sine of the angle up to which planes of two views are one, and least part of the views that have one.
const TILTED: f64 = 0.1;
const AGREE: f64 = 0.2;
/// Share of the object that is lower than its head, and higher than its foot.
const HIGHEST: f64 = 0.97;
/// Width of what is beside the foot, as a part of the foot's own half, and heights there that are tried for a top.
const BESIDE: f64 = 0.4;
const OFFSETS: usize = 200;
/// Share of what is beside the foot that lies on a top which shows, and a quantile of its height where it is the sides of one that does not.
const FLAT: f64 = 0.5;
const SIDES: f64 = 0.9;
/// How many times as far out one half of its sides may be as the other, the lower and the upper one: a slope has no top.
const SHEER: f64 = 1.1;
/// Directions in which the rim of a top is looked for, and the share of the points on its sides that are within it.
const DIRECTIONS: usize = 48;
const RIM: f64 = 0.98;
/// Part of the way from a top's middle to its rim from which on depth that is little higher is the rim's.
const WITHIN_RIM: f64 = 0.8;
/// Part of what depth bleeds by that is the noise of the rim's own.
const ON_RIM: f64 = 0.1;
/// Least share of the points around all holes that lie on a top, and how many may be seen through it below the object, as a part of these.
const TOP: f64 = 0.005;
const LOOKED_THROUGH: f64 = 0.1;
/// Points farther than this many times the median from the middle of all are strays of the matching.
const STRAY: f64 = 3.0;

/// A plane that an object stands on, in a camera's coordinates.
#[derive(Clone)]
pub struct Support {
    plane: Plane,
    axes: [DVec3; 2],
    /// The object's height above it.
    tall: f64,
    /// Corners, along the axes, of the least convex polygon with all points of the object, counterclockwise.
    corners: Vec<DVec2>,
    /// Corners of the same polygon of those points that are next to the plane: there the object stands.
    foot: Vec<DVec2>,
}

impl Support {
    /// Of a plane `a x/z + b y/z + c = 1/z` and points of the object, if it stands on that.
    pub fn new(plane: Plane, object: &[DVec3]) -> Option<Self> {
        if object.len() < FEWEST {
            return None;
        }
        let p = DVec3::from(plane);
        let (normal, distance) = (p.normalize(), 1.0 / p.length());
        // Towards the camera.
        let heights: Vec<f64> = object.iter().map(|point| distance - normal.dot(*point)).collect();
        let tall = quantile(heights.iter().copied(), 0.95).filter(|tall| *tall > 0.0)?;
        let part =
            |is: &dyn Fn(f64) -> bool| heights.iter().filter(|h| is(**h / tall)).count() as f64 / heights.len() as f64;
        let rests =
            part(&|h| h > CLEAR) >= RISES && part(&|h| h < -CLEAR) <= BEHIND && part(&|h| h.abs() < CLEAR) >= TOUCHES;
        if !rests {
            return None;
        }
        let (across, down) = normal.any_orthonormal_pair();
        let axes = [across, down];
        let around = |is: &dyn Fn(f64) -> bool| -> Option<Vec<DVec2>> {
            let these = object.iter().zip(&heights).filter(|(_, h)| is(**h / tall));
            let dropped: Vec<DVec2> = these.map(|(point, _)| DVec2::new(point.dot(across), point.dot(down))).collect();
            let middle = DVec2::new(median(dropped.iter().map(|p| p.x))?, median(dropped.iter().map(|p| p.y))?);
            let reach = STRAY * median(dropped.iter().map(|p| p.distance(middle)))?;
            Some(hull(dropped.into_iter().filter(|p| p.distance(middle) <= reach).collect()))
        };
        let corners = around(&|h| h > CLEAR)?;
        let foot = around(&|h| h <= FOOT && h > -ON_IT).unwrap_or_default();
        (corners.len() >= 3).then_some(Self { plane, axes, tall, corners, foot })
    }

    /// Whether a point in the camera's coordinates lies on it, by the object's height.
    pub fn has(&self, point: DVec3) -> bool {
        let p = DVec3::from(self.plane);
        (1.0 - p.dot(point)).abs() / p.length() <= ON_IT * self.tall
    }

    /// Whether this is its plane.
    pub fn is(&self, plane: &Plane) -> bool {
        self.plane == *plane
    }

    /// Depth z at which a ray (x/z, y/z) meets the plane under the object; nothing beside it.
    pub fn under(&self, ray: [f64; 2]) -> Option<f64> {
        self.within(&self.corners, ray)
    }

    /// Depth z at which a ray meets the plane where the object stands on it; nothing beside that.
    fn below(&self, ray: [f64; 2]) -> Option<f64> {
        self.within(&self.foot, ray)
    }

    fn within(&self, corners: &[DVec2], ray: [f64; 2]) -> Option<f64> {
        let z = 1.0 / planes::on(&self.plane, ray);
        let at = self.place(DVec3::new(ray[0], ray[1], 1.0) * z);
        (z > 0.0 && z.is_finite() && inside(corners, at)).then_some(z)
    }

    /// Where a point in the camera's coordinates falls, along the axes.
    fn place(&self, point: DVec3) -> DVec2 {
        DVec2::new(point.dot(self.axes[0]), point.dot(self.axes[1]))
    }

    /// Whether a point, at a depth z along a ray, is over its rim by no more than this length at z = 1: depth bleeds over the end of a top.
    pub fn bleeds(&self, ray: [f64; 2], z: f64, length: f64) -> bool {
        let point = DVec3::new(ray[0], ray[1], 1.0) * z;
        let p = DVec3::from(self.plane);
        let above = (1.0 - p.dot(point)) / p.length();
        (ON_RIM * length * z..=length * z).contains(&above)
            && (WITHIN_RIM..=1.0 + BESIDE).contains(&self.reach(self.place(point)))
    }

    /// Whether the object stands at a place along the axes.
    fn is_on_foot(&self, at: DVec2) -> bool {
        inside(&self.foot, at)
    }

    /// Factor by which the foot grows about its middle until it reaches a place along the axes: at most 1 where the object stands, infinite without
    /// a foot.
    fn reach(&self, at: DVec2) -> f64 {
        let n = self.foot.len();
        let middle = self.foot.iter().sum::<DVec2>() / n.max(1) as f64;
        let off = |i: usize, at: DVec2| (self.foot[(i + 1) % n] - self.foot[i]).perp_dot(at - middle);
        let sides = (0..n).map(|i| off(i, at) / off(i, self.foot[i]));
        sides.reduce(f64::max).filter(|_| n >= 3).unwrap_or(f64::INFINITY)
    }
}

/// The top of what an object stands on, of which little shows around it.
pub(super) struct Top {
    pub plane: Common,
    /// Points on it that are shown, or its rim.
    shown: Vec<DVec3>,
    /// Whether it is known to end where the points do.
    has_rim: bool,
}

/// Whether a place is within the corners of a convex polygon, counterclockwise.
fn inside(corners: &[DVec2], at: DVec2) -> bool {
    let n = corners.len();
    let left = |i: usize| (corners[(i + 1) % n] - corners[i]).perp_dot(at - corners[i]) >= 0.0;
    n >= 3 && (0..n).all(left)
}

/// The corners of the least convex polygon around points, counterclockwise (Andrew 1979).
fn hull(mut points: Vec<DVec2>) -> Vec<DVec2> {
    points.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    points.dedup();
    let half = |points: &mut dyn Iterator<Item = DVec2>| {
        let mut corners: Vec<DVec2> = vec![];
        for point in points {
            while let [.., a, b] = corners[..] {
                if (b - a).perp_dot(point - a) > 0.0 {
                    break;
                }
                corners.pop();
            }
            corners.push(point);
        }
        corners.pop();
        corners
    };
    let mut corners = half(&mut points.iter().copied());
    corners.extend(half(&mut points.iter().rev().copied()));
    corners
}

/// The top of something of which hardly more than the sides below it shows: how high it is along this normal, and where its rim is. The points,
/// each with its [`Support::reach`], are nowhere far above the object's foot. They are spread evenly over sheer sides; nothing is told of a
/// slope.
fn end_of_sides(normal: DVec3, foot: f64, points: &[(DVec3, f64)]) -> Option<(f64, Vec<DVec3>)> {
    let height = |share: f64| quantile(points.iter().map(|(point, _)| normal.dot(*point)), share);
    let [middle, high] = [height(0.5)?, height(SIDES)?];
    let reach = |above: bool| {
        median(points.iter().filter(|(point, _)| (normal.dot(*point) > middle) == above).map(|(_, reach)| *reach))
    };
    let offset = foot.min(middle + (high - middle) * 0.5 / (SIDES - 0.5));
    let mut rim: Vec<DVec3> = points.iter().map(|(point, _)| *point + normal * (offset - normal.dot(*point))).collect();
    let (across, down) = normal.any_orthonormal_pair();
    let all = rim.clone();
    for k in 0..DIRECTIONS {
        let (sin, cos) = (std::f64::consts::TAU * k as f64 / DIRECTIONS as f64).sin_cos();
        let way = across * cos + down * sin;
        let farthest = quantile(all.iter().map(|point| way.dot(*point)), RIM)?;
        rim.retain(|point| way.dot(*point) <= farthest);
    }
    let [lower, upper] = [reach(false)?, reach(true)?];
    (lower.max(upper) <= SHEER * lower.min(upper)).then_some((offset, rim))
}

/// The plane as a view sees it, if the object, of these world points, stands on it.
fn carries(plane: &Common, sight: &Sight, object: &[DVec3]) -> Option<Support> {
    let camera = sight.grid.camera;
    let object: Vec<DVec3> = object.iter().map(|p| camera.to_camera(p.to_array()).into()).collect();
    Support::new(plane.seen_by(sight)?, &object)
}

impl Sights {
    /// Views that can be believed.
    fn trusted(&self) -> impl Iterator<Item = &Sight> {
        self.0.iter().filter(|sight| sight.grid.trusted)
    }

    /// Points of the object in all views.
    pub(super) fn object(&self) -> Vec<DVec3> {
        let of = |sight: &Sight| -> Vec<DVec3> {
            sight.of_object().map(|site| sight.point(site, sight.grid.depth[site])).collect()
        };
        let all: Vec<DVec3> = self.trusted().flat_map(of).collect();
        all.iter().copied().step_by(all.len().div_ceil(POINTS).max(1)).collect()
    }

    /// The top of what the object stands on, where that is too small to be found among the planes around: it is parallel to one of
    /// these `common` ones, as high as the object ends, shown beside the object's foot, itself or the sides below it, and nobody looks
    /// through it below the object, by what is measured `around` all holes. Nothing where the object stands on a common plane.
    pub(super) fn top(&self, common: &[Common], around: &[Measured], object: &[DVec3]) -> Option<Top> {
        let sight = self.trusted().next()?;
        // The top, and whether it is one of the common planes.
        let one = |plane: &Common| -> Option<(Top, bool)> {
            let middle = median(object.iter().map(|p| plane.normal.dot(*p)))?;
            let way = if middle > plane.offset { 1.0 } else { -1.0 };
            let (normal, parallel) = (plane.normal * way, plane.offset * way);
            let heights = || object.iter().map(|p| normal.dot(*p));
            let [foot, head] = [quantile(heights(), 1.0 - HIGHEST)?, quantile(heights(), HIGHEST)?];
            let at = |offset: f64| {
                let plane = Common { normal, offset };
                Some((plane, carries(&plane, sight, object)?))
            };
            let (_, support) = at(foot)?;
            let camera = sight.grid.camera;
            let dropped = |point: DVec3| support.place(camera.to_camera(point.to_array()).into());
            let near = |at: &&Measured| {
                let above = (normal.dot(at.point) - foot) / (head - foot);
                (-FOOT..=ON_IT).contains(&above) && support.reach(dropped(at.point)) <= 1.0 + BESIDE
            };
            let beside: Vec<&Measured> = around.iter().filter(near).collect();
            let heights: Vec<f64> = beside.iter().map(|at| normal.dot(at.point)).collect();
            let on = |offset: f64| {
                let plane = Common { normal, offset };
                beside.iter().filter(move |at| plane.has(at)).map(|at| at.point)
            };
            // As high as most of them are.
            let every = heights.len().div_ceil(OFFSETS).max(1);
            let tried = heights.iter().copied().step_by(every).map(|offset| (on(offset).count(), offset));
            let flat = tried.max_by_key(|(on, _)| *on).filter(|(on, _)| *on as f64 >= FLAT * beside.len() as f64);
            let sides = || {
                let points: Vec<(DVec3, f64)> =
                    beside.iter().map(|at| (at.point, support.reach(dropped(at.point)))).collect();
                end_of_sides(normal, foot, &points)
            };
            let has_rim = flat.is_none();
            let (offset, shown) = flat.map(|(_, offset)| (offset, on(offset).collect())).or_else(sides)?;
            let (plane, support) = at(offset)?;
            let through = |at: &&Measured| {
                let [eye, there] = [at.eye, at.point].map(|p| normal.dot(p) - offset);
                let goes_through = eye > 0.0 && there < 0.0 && !plane.has(at);
                goes_through && support.is_on_foot(dropped(at.eye + (at.point - at.eye) * (eye / (eye - there))))
            };
            let through = around.iter().filter(through).count();
            let known = (offset - parallel).abs() <= ON_IT * (head - foot);
            log::debug!(
                "support: of {} points {} tell of a top, {through} seen through it; known: {known}",
                around.len(),
                shown.len()
            );
            let share = |count: usize| count as f64 / around.len() as f64;
            let shows = share(shown.len()) >= TOP && (through as f64) < LOOKED_THROUGH * shown.len() as f64;
            let is = shows && (known || share(on(offset).count()) < LEAST);
            is.then_some((Top { plane, shown, has_rim }, known))
        };
        let found: Vec<(Top, bool)> = common.iter().filter_map(one).collect();
        if found.iter().any(|(_, known)| *known) {
            return None;
        }
        found.into_iter().map(|(top, _)| top).max_by_key(|top| top.shown.len())
    }

    /// Finds where the object stands, of which these are points: on this top, as far as that is shown, or on the plane that most views have
    /// it stand on. A table that nobody sees below the object does not let the floor be seen that others see past the table.
    pub(super) fn stand(&mut self, top: Option<Top>, object: &[DVec3]) {
        let stood = || self.agreed(object).map(|plane| Top { plane, shown: vec![], has_rim: false });
        if let Some(Top { plane, mut shown, has_rim }) = top.or_else(stood) {
            if !has_rim {
                shown.extend(object);
            }
            let of = |sight: &Sight| {
                let mut support = carries(&plane, sight, if has_rim { object } else { &shown })?;
                if has_rim {
                    let places = shown.iter().map(|p| support.place(sight.grid.camera.to_camera(p.to_array()).into()));
                    support.foot = hull(places.collect());
                }
                Some(support)
            };
            self.0.par_iter_mut().for_each(|sight| {
                let support = of(sight);
                let at = |site: usize| support.as_ref().filter(|_| sight.hole[site])?.below(sight.ray(site));
                sight.stands = (0..sight.hole.len()).map(|site| at(site).unwrap_or(f64::NAN)).collect();
                sight.top = support.filter(|_| has_rim);
            });
        }
    }

    /// The plane that most views have the object stand on, of which these are points.
    fn agreed(&self, object: &[DVec3]) -> Option<Common> {
        // What one view alone takes for a plane may pass before the object.
        let views: Vec<&Sight> = self.trusted().collect();
        let of = |sight: &&Sight| -> Vec<(Common, f64)> {
            let planes = sight.supports(&sight.around).into_iter().map(|support| Common::of(&support.plane, sight));
            planes.filter_map(|plane| Some((plane, carries(&plane, sight, object)?.tall))).collect()
        };
        let found: Vec<(Common, f64)> = views.par_iter().map(of).collect::<Vec<_>>().concat();
        let middle = object.iter().sum::<DVec3>() / object.len().max(1) as f64;
        let agree =
            |(a, tall): &(Common, f64)| found.iter().filter(|(b, _)| a.is(b, middle, TILTED, ON_IT * tall)).count();
        let agree: Vec<usize> = found.iter().map(agree).collect();
        let best = (0..found.len()).max_by_key(|i| (agree[*i], std::cmp::Reverse(*i)))?;
        let enough = agree[best] >= 2 && agree[best] as f64 >= AGREE * views.len() as f64;
        enough.then(|| found[best].0)
    }
}

impl Sight {
    /// The sites at which others confirm the object's depth.
    fn of_object(&self) -> impl Iterator<Item = usize> {
        // The margin around the object shows what is behind it.
        let deep = |site: usize| self.around(site).all(|near| self.hole[near]);
        (0..self.hole.len()).filter(move |site| self.grid.confirmed[*site] && deep(*site))
    }

    /// The planes, of these of the view, that the object stands on.
    pub(super) fn supports(&self, planes: &[Plane]) -> Vec<Support> {
        let object: Vec<DVec3> = (self.of_object())
            .map(|site| {
                let [x, y] = self.ray(site);
                DVec3::new(x, y, 1.0) * self.grid.depth[site]
            })
            .collect();
        let supports: Vec<Support> =
            self.shown(planes).iter().filter_map(|plane| Support::new(*plane, &object)).collect();
        log::debug!("surface: {} planes, the object stands on {}", planes.len(), supports.len());
        supports
    }

    /// The planes, of these of the view, that it shows around its hole: not only where they cross one before them.
    fn shown(&self, planes: &[Plane]) -> Vec<Plane> {
        let near = self.surroundings();
        let known = (0..near.len()).filter(|site| near[*site] && !self.hole[*site] && self.depth[*site].is_finite());
        let on = |site: usize, plane: &Plane| {
            (planes::on(plane, self.ray(site)) * self.depth[site] - 1.0).abs() <= planes::THICKNESS
        };
        let (mut counts, mut all) = (vec![0usize; planes.len()], 0usize);
        for site in known {
            all += 1;
            if let Some(first) = planes.iter().position(|plane| on(site, plane)) {
                counts[first] += 1;
            }
        }
        let enough = |count: usize| count as f64 >= SHOWN * all as f64;
        planes.iter().zip(counts).filter(|(_, count)| enough(*count)).map(|(plane, _)| *plane).collect()
    }
}

#[cfg(test)]
mod tests {
    use image::GrayImage;

    use super::*;
    use crate::multiview::DepthGrid;
    use crate::scene::Camera;

    /// A floor a unit and a half below the camera, with y downwards: y = 1.5.
    const FLOOR: Plane = [0.0, 1.0 / 1.5, 0.0];

    /// The front and the top of a box of one unit on the floor, at `lift` above it.
    fn cube(lift: f64) -> Vec<DVec3> {
        let steps = || (0..=10).map(|i| f64::from(i) / 10.0);
        let grid = || steps().flat_map(|u| steps().map(move |v| (u, v)));
        let front = grid().map(|(u, v)| DVec3::new(u, 1.5 - lift - v, 4.0));
        front.chain(grid().map(|(u, v)| DVec3::new(u, 0.5 - lift, 4.0 + v))).collect()
    }

    #[test]
    fn the_floor_goes_on_under_the_object() {
        let support = Support::new(FLOOR, &cube(0.0)).expect("it stands on the floor");
        let ray = |x: f64, z: f64| [x / z, 1.5 / z];
        for (x, z, is_under) in
            [(0.5, 4.5, true), (0.05, 4.9, true), (0.5, 3.8, false), (1.2, 4.5, false), (0.5, 5.3, false)]
        {
            let z_under = support.under(ray(x, z));
            assert_eq!(z_under.is_some(), is_under, "{x} {z}");
            assert!(z_under.is_none_or(|found| (found - z).abs() < 1e-9));
        }
    }

    /// Depth little above the rim is the rim's; what is measured much above it, above its middle, or on it is there.
    #[test]
    fn depth_bleeds_over_the_rim() {
        let mut support = Support::new(FLOOR, &cube(0.0)).expect("it stands on the floor");
        let rim = [(0.0, 4.0), (1.0, 4.0), (1.0, 5.0), (0.0, 5.0)];
        support.foot = hull(rim.map(|(x, z)| support.place(DVec3::new(x, 1.5, z))).to_vec());
        let bleeds = |x: f64, above: f64, z: f64| support.bleeds([x / z, (1.5 - above) / z], z, 0.05);
        assert!(bleeds(0.5, 0.1, 4.97) && bleeds(0.5, 0.1, 5.05) && bleeds(1.1, 0.1, 4.5));
        assert!(!bleeds(0.5, 0.4, 5.0) && !bleeds(0.5, 0.1, 4.5) && !bleeds(0.5, 0.01, 4.97) && !bleeds(0.5, 0.1, 5.5));
        assert!(!bleeds(0.5, -0.1, 5.05));
    }

    /// What hangs in the air does not stand on the floor, nor does what goes through it.
    #[test]
    fn what_does_not_touch_does_not_stand() {
        assert!(Support::new(FLOOR, &cube(0.5)).is_none());
        assert!(Support::new(FLOOR, &cube(-0.6)).is_none());
        assert!(Support::new(FLOOR, &cube(0.0)[..20]).is_none());
    }

    const SIZE: [u32; 2] = [120, 90];

    /// One of eight cameras around a box of one unit on a table of this half width, over a floor, y downwards: the camera, the mask, the
    /// depth of what each pixel shows, and of what it would show without the box.
    fn table(turn: usize, half: f64) -> (Camera, GrayImage, DepthGrid, Vec<f64>) {
        let (sin, cos) = (std::f64::consts::TAU * turn as f64 / 8.0).sin_cos();
        let eye = DVec3::new(5.0 * sin, -3.0, -5.0 * cos);
        let ahead = (DVec3::new(0.0, -0.2, 0.0) - eye).normalize();
        let across = DVec3::Y.cross(ahead).normalize();
        let rows = [across, ahead.cross(across), ahead];
        let camera = Camera {
            rotation: rows.map(|row| row.to_array().map(|v| v as f32)),
            translation: rows.map(|row| -row.dot(eye)),
            focal: [110.0; 2],
            principal: [60.0, 45.0],
            distortion: [0.0; 4],
            size: SIZE,
        };
        let pixels = (SIZE[0] * SIZE[1]) as usize;
        let met = |way: DVec3, [low, high]: [DVec3; 2]| {
            let [low, high] = [(low - eye) / way, (high - eye) / way];
            let (enter, leave) = (low.min(high).max_element(), low.max(high).min_element());
            if enter < leave { enter } else { f64::INFINITY }
        };
        let shown = |pixel: usize| {
            let way = DVec3::from(camera.lift(camera.pixel_center(pixel), 1.0).expect("a ray")) - eye;
            let slab = [DVec3::new(-half, 0.0, -half), DVec3::new(half, 0.05, half)];
            let behind = met(way, slab).min(if way.y > 0.0 { (1.5 - eye.y) / way.y } else { 50.0 });
            (met(way, [DVec3::new(-0.5, -0.8, -0.5), DVec3::new(0.5, 0.0, 0.5)]), behind)
        };
        let (boxed, behind): (Vec<f64>, Vec<f64>) = (0..pixels).map(shown).unzip();
        let depth = boxed.iter().zip(&behind).map(|(a, b)| a.min(*b)).collect();
        let mask = boxed.iter().map(|z| if z.is_finite() { 255 } else { 0 }).collect();
        let mask = GrayImage::from_raw(SIZE[0], SIZE[1], mask).expect("a byte per pixel");
        let (confirmed, colors) = (vec![true; pixels], vec![[90; 3]; pixels]);
        let grid =
            DepthGrid { camera, stride: 1, columns: SIZE[0], rows: SIZE[1], depth, confirmed, colors, trusted: true };
        (camera, mask, grid, behind)
    }

    /// Nobody sees the table under the object, and past its edge everybody sees the floor, which lies behind the table in every view.
    #[test]
    fn the_floor_does_not_show_through_the_table() {
        let views: Vec<_> = (0..8).map(|turn| table(turn, 0.8)).collect();
        let cameras: Vec<Camera> = views.iter().map(|view| view.0).collect();
        let masks: Vec<GrayImage> = views.iter().map(|view| view.1.clone()).collect();
        let mut sights = Sights::new(views.iter().map(|view| view.2.clone()).collect(), &cameras, &masks, &masks);
        for (sight, camera) in sights.0.iter_mut().zip(&cameras) {
            // The planes y = 0 and y = 1.5 of the world.
            let down = camera.rotation.map(|row| f64::from(row[1]));
            sight.around = [0.0, 1.5].map(|y| down.map(|v| v / (y - camera.center()[1]))).to_vec();
        }
        let through = |sights: &Sights| {
            let carried = sights.carried(0).into_iter().zip(&views[0].3);
            carried.filter(|((z, _), behind)| *z > 1.1 * **behind).count()
        };
        assert!(through(&sights) > 100, "{}", through(&sights));
        let object = sights.object();
        sights.stand(None, &object);
        assert!(through(&sights) < 20, "{}", through(&sights));
        for of in [0, 3] {
            sights.solve(of, 1);
            let (sight, behind) = (&sights.0[of], &views[of].3);
            let holes: Vec<usize> = (0..sight.hole.len()).filter(|site| sight.hole[*site]).collect();
            let under: Vec<usize> = holes.iter().copied().filter(|site| sight.stands[*site].is_finite()).collect();
            let right = |sites: &[usize]| {
                sites.iter().filter(|site| (sight.depth[**site] / behind[**site] - 1.0).abs() < 0.02).count()
            };
            assert!(under.len() > 100 && right(&under) == under.len(), "{} of {}", right(&under), under.len());
            assert!(right(&holes) * 20 > holes.len() * 19, "{} of {}", right(&holes), holes.len());
        }
    }

    /// A table's top that hardly shows around the box is found over the floor, and not where it is known already.
    #[test]
    fn the_top_is_where_the_object_ends() {
        let plane = |y: f64| Common { normal: DVec3::Y, offset: y };
        let views: Vec<_> = (0..8).map(|turn| table(turn, 0.58)).collect();
        let cameras: Vec<Camera> = views.iter().map(|view| view.0).collect();
        let masks: Vec<GrayImage> = views.iter().map(|view| view.1.clone()).collect();
        let sights = Sights::new(views.into_iter().map(|view| view.2).collect(), &cameras, &masks, &masks);
        let (around, object) = (sights.measured_around(), sights.object());
        let found = sights.top(&[plane(1.5)], &around, &object).expect("the box stands on something");
        let (top, shown) = (found.plane, found.shown);
        assert!(!found.has_rim, "the top itself is seen");
        assert!(shown.iter().all(|point| point.x.abs().max(point.z.abs()) < 0.6), "it is no larger than it is");
        assert!(top.normal.y.abs() > 0.999 && (top.offset * top.normal.y).abs() < 0.03, "{top:?}");
        assert!(sights.top(&[plane(1.5), plane(0.0)], &around, &object).is_none(), "it is known");
        let lifted: Vec<DVec3> = object.iter().map(|point| *point - DVec3::Y).collect();
        assert!(sights.top(&[plane(1.5)], &around, &lifted).is_none(), "it stands on air");
    }

    /// A block of half a unit to each side is as high, 0.6, and as wide as its sides, which alone are seen, and not as a stray beside it. A hill
    /// has no top.
    #[test]
    fn sheer_sides_end_with_the_top() {
        let block = |slope: f64| -> Vec<(DVec3, f64)> {
            let places = (0..400).map(|i| (f64::from(i % 20) / 20.0, f64::from(i / 20) / 20.0, i % 4));
            let of = |(along, below, side): (f64, f64, i32)| {
                let (out, along, low) = (0.5 + slope * 0.2 * below, along - 0.5, 0.6 - 0.2 * below);
                let (sin, cos) = (0.25 * std::f64::consts::TAU * f64::from(side)).sin_cos();
                (DVec3::new(cos * out - sin * along, low, sin * out + cos * along), out / 0.45)
            };
            places.map(of).chain([(DVec3::new(0.62, 0.55, 0.0), 1.38)]).collect()
        };
        let (height, rim) = end_of_sides(DVec3::Y, 0.63, &block(0.0)).expect("it has a top");
        assert!((height - 0.6).abs() < 0.015, "{height}");
        let wide = rim.iter().fold(0.0, |wide: f64, p| wide.max(p.x.abs()).max(p.z.abs()));
        assert!((0.49..0.51).contains(&wide) && rim.iter().all(|p| (p.y - height).abs() < 1e-9), "{wide}");
        assert!(end_of_sides(DVec3::Y, 0.63, &block(1.0)).is_none());
    }

    #[test]
    fn the_hull_of_points_goes_around_them() {
        let grid: Vec<DVec2> = (0..25).map(|i| DVec2::new(f64::from(i % 5), f64::from(i / 5))).collect();
        assert_eq!(hull(grid), [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]].map(DVec2::from));
        assert!(hull(vec![DVec2::ZERO; 4]).len() < 3);
    }
}
