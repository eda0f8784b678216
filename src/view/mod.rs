//! An exported scene in the browser: a page around SuperSplat's viewer, served or as one file.
//!
//! The viewer (`supersplat/`, MIT) is part of the program, so that nothing is fetched from anywhere. The page starts at a
//! training camera, in a frame of the photograph's proportions; a slider draws the photograph over it, before and after.
//! SuperSplat turns a PLY half round the z axis: up is -y in the file and +y in the page.

pub mod server;

use std::io::Write as _;

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use flate2::Compression;
use flate2::write::GzEncoder;
use serde_json::{Value, json};

use server::Resource;

/// The viewer's program, gzip.
const VIEWER: &[u8] = include_bytes!("supersplat/index.js.gz");
/// The viewer's style.
const STYLE: &[u8] = include_bytes!("supersplat/index.css");
/// The viewer's licence.
pub const LICENSE: &str = include_str!("supersplat/LICENSE");
const TEMPLATE: &str = include_str!("page.html");
const CONFIG: &str = "<!--config-->";
const ASSETS: &str = "<!--assets-->";

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
    /// The start's photograph as JPEG.
    pub photograph: Option<Vec<u8>>,
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

    fn html(&self, assets: &str) -> String {
        // Within a script element, `<` would begin the end of it.
        let config = self.config().to_string().replace('<', "\\u003c");
        let (head, rest) = TEMPLATE.split_once(CONFIG).expect("the page has a place for its settings");
        let (middle, tail) = rest.split_once(ASSETS).expect("the page has a place for its assets");
        [head, &config, middle, assets, tail].concat()
    }

    /// The page and what it fetches, for a server.
    pub fn resources(&self) -> Vec<Resource> {
        let plain = |path: &'static str, kind, bytes: Vec<u8>| Resource { path, kind, gzip: false, bytes };
        let mut all = vec![
            plain("/", "text/html; charset=utf-8", self.html("").into_bytes()),
            Resource { path: "/viewer.js", kind: "text/javascript", gzip: true, bytes: VIEWER.to_vec() },
            plain("/viewer.css", "text/css", STYLE.to_vec()),
            plain("/scene.ply", "application/octet-stream", self.ply.clone()),
            plain("/LICENSE", "text/plain; charset=utf-8", LICENSE.as_bytes().to_vec()),
        ];
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
        if let Some(jpeg) = &self.photograph {
            add("photograph.jpg", &packed(jpeg)?);
        }
        Ok(self.html(&assets))
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

    #[test]
    fn a_name_cannot_break_out_of_the_page() {
        let html = page().html("");
        let script = html.split_once("id=\"config\">").expect("the settings").1;
        let text = script.split_once("</script>").expect("its end").0;
        let config: Value = serde_json::from_str(text).expect("JSON");
        assert_eq!(config["title"], json!(page().title));
    }

    #[test]
    fn one_page_holds_everything() {
        let html = page().single().expect("memory");
        for name in ["viewer.js", "viewer.css", "scene.ply", "photograph.jpg"] {
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
    }
}
