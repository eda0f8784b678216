//! An exported scene in the browser: a page around SuperSplat's viewer, served or as one file. A training that is under
//! way is shown by [`live`].
//!
//! The viewer (`supersplat/`, MIT) is part of the program, so that nothing is fetched from anywhere. The page starts at a
//! training camera, in a frame of the photograph's proportions; a slider draws the photograph over it, before and after, and what was
//! guessed may be tinted.
//! SuperSplat turns a PLY half round the z axis: up is -y in the file and +y in the page.

pub mod live;
pub mod server;

use std::io::Write as _;

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use flate2::Compression;
use flate2::write::GzEncoder;
use glam::{DMat3, DVec3};
use image::{Rgb, RgbImage};
use serde_json::{Value, json};

use server::Resource;

use crate::scene::{Camera, distort};

/// The viewer's program, gzip.
const VIEWER: &[u8] = include_bytes!("supersplat/index.js.gz");
/// The viewer's style.
const STYLE: &[u8] = include_bytes!("supersplat/index.css");
/// The viewer's licence.
pub const LICENSE: &str = include_str!("supersplat/LICENSE");
const TEMPLATE: &str = include_str!("page.html");
/// The page's own program.
const PROGRAM: &str = include_str!("page.js");
/// Places in the template, in their order.
const PLACES: [&str; 4] = ["<!--policy-->", "<!--config-->", "<!--assets-->", "<!--program-->"];
/// As [`server::POLICY`], for a page that holds all it needs.
const SINGLE_POLICY: &str = "default-src 'none'; script-src 'unsafe-inline' blob: 'wasm-unsafe-eval'; \
    style-src 'unsafe-inline' blob:; img-src blob: data:; font-src data:; connect-src blob: data:; worker-src blob:; \
    base-uri 'none'; form-action 'none'";

/// The page's program where it is served.
const SCRIPT: &str = "<script type=\"module\" src=\"page.js\"></script>";

/// Where the page starts, in the axes of the PLY, in which up is -y.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Start {
    /// The camera's centre.
    pub center: [f64; 3],
    /// A point that it looks at, and about which the view turns.
    pub target: [f64; 3],
    /// Field of view across the longer side, degrees.
    pub fov: f64,
    /// Width and height of its photograph in pixels.
    pub size: [u32; 2],
}

/// The camera with which the viewer starts, for a training camera in axes in which up is -y: of the same place, direction
/// and size, but upright, without distortion, its principal point in the middle, its pixels square.
pub fn upright(camera: &Camera) -> Camera {
    let ahead = DVec3::from_array(camera.rotation[2].map(f64::from)).normalize_or(DVec3::Z);
    let right = DVec3::Y.cross(ahead).try_normalize().unwrap_or(DVec3::X);
    let rotation = [right, ahead.cross(right), ahead].map(|axis| axis.to_array().map(|v| v as f32));
    let longer = usize::from(camera.size[1] >= camera.size[0]);
    Camera {
        rotation,
        translation: Camera::translation_to(&rotation, camera.center()),
        focal: [camera.focal[longer]; 2],
        principal: camera.size.map(|side| side as f32 / 2.0),
        distortion: [0.0; 4],
        size: camera.size,
    }
}

/// A photograph as another camera at the same place would have taken it, black where it shows nothing.
pub fn resampled(photograph: &RgbImage, camera: &Camera, to: &Camera) -> RgbImage {
    // Columns are the axes: of the camera in the world, then of the other in the camera.
    let axes = |camera: &Camera| DMat3::from_cols_array_2d(&camera.rotation.map(|row| row.map(f64::from)));
    let turn = axes(camera).transpose() * axes(to);
    let [focal, principal] = [to.focal, to.principal].map(|v| v.map(f64::from));
    let (width, height) = photograph.dimensions();
    RgbImage::from_fn(to.size[0], to.size[1], |x, y| {
        let at = [(f64::from(x) + 0.5 - principal[0]) / focal[0], (f64::from(y) + 0.5 - principal[1]) / focal[1]];
        let ray = turn * DVec3::new(at[0], at[1], 1.0);
        let black = Rgb([0; 3]);
        if ray.z <= 0.0 {
            return black;
        }
        let seen = distort([ray.x / ray.z, ray.y / ray.z], camera.distortion.map(f64::from));
        let pixel: [f64; 2] =
            std::array::from_fn(|i| seen[i] * f64::from(camera.focal[i]) + f64::from(camera.principal[i]));
        let inside = (0..2).all(|i| (0.0..f64::from([width, height][i])).contains(&pixel[i]));
        if !inside {
            return black;
        }
        // Between the four nearest centres, of which those beyond the edge are those on it.
        let corner = pixel.map(|v| (v - 0.5).floor());
        let share: [f64; 2] = std::array::from_fn(|i| pixel[i] - 0.5 - corner[i]);
        let stored = |dx: f64, dy: f64| {
            let clamp = |v: f64, size: u32| v.clamp(0.0, f64::from(size - 1)) as u32;
            photograph.get_pixel(clamp(corner[0] + dx, width), clamp(corner[1] + dy, height)).0.map(f64::from)
        };
        let corners = [stored(0.0, 0.0), stored(1.0, 0.0), stored(0.0, 1.0), stored(1.0, 1.0)];
        Rgb(std::array::from_fn(|c| {
            let row = |a: usize| corners[a][c] * (1.0 - share[0]) + corners[a + 1][c] * share[0];
            (row(0) * (1.0 - share[1]) + row(2) * share[1]).round() as u8
        }))
    })
}

/// A scene to show.
#[derive(Debug, Clone)]
pub struct Page {
    /// What it is called.
    pub title: String,
    /// The PLY file.
    pub ply: Vec<u8>,
    /// Where it starts.
    pub start: Start,
    /// What shines through, 0 to 1.
    pub background: [f64; 3],
    /// What the start's photograph shows from the viewer's camera ([`upright`]) as JPEG.
    pub photograph: Option<Vec<u8>>,
    /// `[gaussian]` in the PLY's order, 0 where photographs show it to 255 where it is guessed: the page tints by it.
    pub guessed: Option<Vec<u8>>,
}

impl Page {
    fn config(&self) -> Value {
        // Half a turn about z.
        let turned = |[x, y, z]: [f64; 3]| [-x, -y, z];
        let Start { center, target, fov, size: [width, height] } = self.start;
        let off = |extra: Value| {
            let mut off = json!({ "enabled": false });
            if let (Some(all), Some(extra)) = (off.as_object_mut(), extra.as_object()) {
                all.extend(extra.clone());
            }
            off
        };
        json!({
            "title": self.title,
            "aspect": f64::from(width) / f64::from(height),
            "photograph": self.photograph.is_some(),
            "guessed": self.guessed.is_some(),
            "settings": {
                "version": 2,
                "tonemapping": "none",
                "highPrecisionRendering": false,
                "background": { "color": self.background },
                "postEffectSettings": {
                    "sharpness": off(json!({ "amount": 0 })),
                    "bloom": off(json!({ "intensity": 0.1, "blurLevel": 2 })),
                    "grading": off(json!({ "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1] })),
                    "vignette": off(json!({ "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1 })),
                    "fringing": off(json!({ "intensity": 0.5 })),
                },
                "animTracks": [],
                "cameras": [{ "initial": { "position": turned(center), "target": turned(target), "fov": fov } }],
                "annotations": [],
                "startMode": "default",
            },
        })
    }

    fn html(&self, policy: &str, assets: &str, program: &str) -> String {
        // Within a script element, `<` would begin the end of it.
        let config = self.config().to_string().replace('<', "\\u003c");
        let mut html = String::new();
        let mut rest = TEMPLATE;
        for (place, text) in PLACES.into_iter().zip([policy, &config, assets, program]) {
            let (before, after) = rest.split_once(place).expect("the page has a place for it");
            html += before;
            html += text;
            rest = after;
        }
        html + rest
    }

    /// The page and what it fetches, for a server.
    pub fn resources(&self) -> Vec<Resource> {
        let plain = |path: &'static str, kind, bytes: Vec<u8>| Resource { path, kind, gzip: false, bytes };
        let mut all = vec![
            plain("/", "text/html; charset=utf-8", self.html("", "", SCRIPT).into_bytes()),
            plain("/page.js", "text/javascript", PROGRAM.as_bytes().to_vec()),
            Resource { path: "/viewer.js", kind: "text/javascript", gzip: true, bytes: VIEWER.to_vec() },
            plain("/viewer.css", "text/css", STYLE.to_vec()),
            plain("/scene.ply", "application/octet-stream", self.ply.clone()),
            plain("/LICENSE", "text/plain; charset=utf-8", LICENSE.as_bytes().to_vec()),
        ];
        all.extend(self.guessed.clone().map(|bytes| plain("/guessed.bin", "application/octet-stream", bytes)));
        all.extend(self.photograph.clone().map(|jpeg| plain("/photograph.jpg", "image/jpeg", jpeg)));
        all
    }

    /// One page that needs nothing else.
    ///
    /// # Errors
    /// When memory for the compressed files cannot be had.
    pub fn single(&self) -> std::io::Result<String> {
        let packed = |bytes: &[u8]| -> std::io::Result<Vec<u8>> {
            let mut out = GzEncoder::new(vec![], Compression::best());
            out.write_all(bytes)?;
            out.finish()
        };
        let mut assets = format!("<!--\nThe viewer, @playcanvas/supersplat-viewer:\n{LICENSE}-->\n");
        let mut add = |name: &str, gzip: &[u8]| {
            assets += &format!("<script type=\"application/gzip\" id=\"asset-{name}\">");
            BASE64_STANDARD.encode_string(gzip, &mut assets);
            assets += "</script>\n";
        };
        add("viewer.js", VIEWER);
        add("viewer.css", &packed(STYLE)?);
        add("scene.ply", &packed(&self.ply)?);
        for (name, bytes) in [("photograph.jpg", &self.photograph), ("guessed.bin", &self.guessed)] {
            if let Some(bytes) = bytes {
                add(name, &packed(bytes)?);
            }
        }
        let policy = format!("<meta http-equiv=\"Content-Security-Policy\" content=\"{SINGLE_POLICY}\">");
        Ok(self.html(&policy, &assets, &format!("<script type=\"module\">\n{PROGRAM}</script>")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn page() -> Page {
        Page {
            title: "a </script> <b>\"name\"".to_owned(),
            ply: vec![7; 1000],
            start: Start { center: [1.0, 2.0, 3.0], target: [4.0, -5.0, 6.0], fov: 55.0, size: [160, 120] },
            background: [0.0, 0.5, 1.0],
            photograph: Some(vec![1, 2, 3]),
            guessed: Some(vec![0, 255]),
        }
    }

    #[test]
    fn the_camera_is_turned_as_the_viewer_turns_the_file() {
        let config = page().config();
        let initial = &config["settings"]["cameras"][0]["initial"];
        assert_eq!(initial["position"], json!([-1.0, -2.0, 3.0]));
        assert_eq!(initial["target"], json!([-4.0, 5.0, 6.0]));
        assert_eq!((&config["aspect"], &config["photograph"]), (&json!(160.0 / 120.0), &json!(true)));
    }

    fn camera(roll: f32) -> Camera {
        let (s, c) = roll.sin_cos();
        let rotation = [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]];
        Camera {
            rotation,
            translation: Camera::translation_to(&rotation, [1.0, 2.0, 3.0]),
            focal: [60.0, 60.0],
            principal: [20.0, 15.0],
            distortion: [0.0; 4],
            size: [40, 30],
        }
    }

    fn photograph() -> RgbImage {
        RgbImage::from_fn(40, 30, |x, y| Rgb([6 * x as u8, 8 * y as u8, (2 * x + 3 * y) as u8]))
    }

    #[test]
    fn an_upright_camera_keeps_its_photograph() {
        let camera = camera(0.0);
        assert_eq!(upright(&camera).rotation, camera.rotation);
        assert!(resampled(&photograph(), &camera, &upright(&camera)) == photograph());
    }

    /// The photograph is linear in x and y, so that its values say where they were taken from.
    #[test]
    fn roll_lens_and_principal_point_are_taken_out() {
        let mut camera = camera(0.1);
        (camera.principal, camera.distortion) = ([22.0, 14.0], [0.05, 0.0, 0.0, 0.0]);
        let to = upright(&camera);
        assert!((to.rotation[0][1]).abs() < 1e-7 && (to.rotation[1][1] - 1.0).abs() < 1e-7);
        let picture = resampled(&photograph(), &camera, &to);
        let center = camera.center();
        let mut compared = 0;
        for (x, y, pixel) in picture.enumerate_pixels() {
            let at = to.unproject([f64::from(x) + 0.5, f64::from(y) + 0.5]).expect("no distortion");
            let rows = to.rotation.map(|row| row.map(f64::from));
            let point = std::array::from_fn(|i| center[i] + at[0] * rows[0][i] + at[1] * rows[1][i] + rows[2][i]);
            let [u, v] = camera.project(point).expect("ahead");
            if (1.0..39.0).contains(&u) && (1.0..29.0).contains(&v) {
                // Half a step of the 8 bits.
                assert!((f64::from(pixel.0[0]) - 6.0 * (u - 0.5)).abs() < 0.51, "{x} {y}");
                assert!((f64::from(pixel.0[1]) - 8.0 * (v - 0.5)).abs() < 0.51, "{x} {y}");
                compared += 1;
            } else if u < 0.0 || v < 0.0 || u > 40.0 || v > 30.0 {
                assert_eq!(pixel.0, [0; 3]);
            }
        }
        assert!(compared > 900, "{compared}");
    }

    #[test]
    fn a_name_cannot_break_out_of_the_page() {
        let html = page().html("", "", SCRIPT);
        let script = html.split_once("id=\"config\">").expect("the settings").1;
        let text = script.split_once("</script>").expect("its end").0;
        let config: Value = serde_json::from_str(text).expect("JSON");
        assert_eq!(config["title"], json!(page().title));
    }

    /// The policy of served pages lets no script run that stands in the page.
    #[test]
    fn served_pages_have_their_programs_in_files() {
        let resources = page().resources();
        let text = |path: &str| {
            let found = resources.iter().find(|resource| resource.path == path).expect(path);
            std::str::from_utf8(&found.bytes).expect("text").to_owned()
        };
        let html = text("/");
        assert!(html.contains("<script type=\"module\" src=\"page.js\"></script>") && !html.contains("createViewer"));
        assert!(text("/page.js").contains("createViewer"));
        assert!(PLACES.iter().all(|place| !html.contains(place)));
    }

    /// The README says what the viewer's program is and how it was changed.
    #[test]
    fn the_viewer_is_the_one_that_its_readme_names() {
        use std::fmt::Write as _;

        use sha2::Digest as _;
        let mut program = vec![];
        std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(VIEWER), &mut program).expect("gzip");
        let mut hash = String::new();
        sha2::Sha256::digest(&program).iter().for_each(|byte| write!(hash, "{byte:02x}").expect("a string"));
        let readme = include_str!("supersplat/README.md");
        assert!(readme.contains(&format!("SHA-256 of what is packed here: `{hash}`")), "{hash}");
        // Handlers that stand in elements are this one, which the servers' policy names.
        let handler = "event.stopPropagation()";
        let hash = BASE64_STANDARD.encode(sha2::Sha256::digest(handler));
        assert!(server::POLICY.contains(&format!("'unsafe-hashes' 'sha256-{hash}'")), "{hash}");
        // Models of controllers in VR came from there.
        let program = String::from_utf8(program).expect("text");
        for event in ["onpointerdown", "onwheel"] {
            assert_eq!(
                program.matches(&format!(" {event}=")).count(),
                program.matches(&format!(" {event}=\\\"{handler}")).count()
            );
        }
        assert!(!program.contains("cdn.") && !program.contains("jsdelivr"), "nothing is fetched from elsewhere");
    }

    #[test]
    fn one_page_holds_everything() {
        let html = page().single().expect("memory");
        for name in ["viewer.js", "viewer.css", "scene.ply", "photograph.jpg", "guessed.bin"] {
            let at = html.split_once(&format!("id=\"asset-{name}\">")).expect(name).1;
            let text = at.split_once("</script>").expect("its end").0;
            let gzip = BASE64_STANDARD.decode(text).expect("base64");
            let mut bytes = vec![];
            std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&gzip[..]), &mut bytes).expect("gzip");
            let want = if name == "scene.ply" { Some(vec![7; 1000]) } else { None };
            assert!(want.is_none_or(|want| want == bytes) && !bytes.is_empty(), "{name}");
        }
        assert!(html.contains("Permission is hereby granted"), "the viewer's licence is in the page");
        assert!(!html.contains("src=\"http") && !html.contains("href=\"http"), "nothing is fetched");
        assert!(html.contains("<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; "));
        assert!(html.contains("const { createViewer } = await import("), "its program is in the page");
    }
}
