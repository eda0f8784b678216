//! Settings of older versions that are gone.

/// A setting that is gone.
struct Removed {
    section: &'static str,
    /// The line that older versions wrote into settings files and checkpoints: the value under which a run goes on as
    /// it began.
    line: &'static str,
    /// A line without which the run would not go on as it began.
    with: Option<&'static str>,
    /// What to do where it has another value.
    instead: &'static str,
}

const REMOVED: [Removed; 11] = [
    Removed {
        section: "optimizer",
        line: "lazy = false",
        with: None,
        instead: "every parameter is updated in every step",
    },
    Removed {
        section: "optimizer",
        line: "betas = [0.9, 0.999]",
        with: None,
        instead: "Adam's decay rates are 0.9 and 0.999",
    },
    Removed {
        section: "optimizer",
        line: "schedule_length = 0",
        with: None,
        instead: "learning rates reach their end in the last step, train.iterations",
    },
    Removed { section: "render", line: "depth_bits = 28", with: None, instead: "sort keys have 28 bits of the depth" },
    Removed {
        section: "train.coarse",
        line: "factor = 2",
        with: None,
        instead: "pictures are halved until train.coarse.until",
    },
    Removed {
        section: "densify",
        line: "growth = 0.05",
        with: None,
        instead: "a round adds 5 % of the plain Gaussians, up to densify.max_gaussians",
    },
    Removed {
        section: "densify",
        line: "coarsest_pixels = 0.0",
        with: None,
        instead: "densify.coarsest_cell says it in voxels: so many pixels over model.voxel_pixels",
    },
    Removed { section: "scene", line: "seed_behind_edges = true", with: Some("seed_hole = true"), instead: SEEDED },
    Removed { section: "scene", line: "seed_behind_edges = false", with: Some("seed_hole = false"), instead: SEEDED },
    Removed {
        section: "losses.depth.gradient",
        line: "reference_weight = 1.0",
        with: None,
        instead: "losses.depth.gradient.weight is the reference's, other_weight the share of it on other views",
    },
    Removed {
        section: "losses.depth",
        line: "reference_inside_region = \"mask\"",
        with: None,
        instead: "the reference's depth weighs more inside the mask; reference_inside_weight says how much",
    },
];

const SEEDED: &str = "scene.seed_hole adds the points behind the hole's depth edges, too";

/// Settings as an older version wrote them, with empty lines in place of those that say nothing any more.
pub fn without_removed(text: &str) -> String {
    let mut section = "";
    let mut kept = String::with_capacity(text.len());
    for line in text.split_inclusive('\n') {
        let bare = line.split(" #").next().unwrap_or_default().trim_end();
        if let Some(head) = bare.strip_prefix('[') {
            section = head.trim_end_matches(']');
        }
        let stays = |with: &str| text.lines().any(|line| line.trim_end() == with);
        let is = |removed: &Removed| (removed.section, removed.line) == (section, bare);
        let gone = REMOVED.iter().any(|removed| is(removed) && removed.with.is_none_or(stays));
        kept += if gone { "\n" } else { line };
    }
    kept
}

/// What to do in place of a setting that is gone, by its dotted key.
pub(super) fn instead(key: &str) -> Option<&'static str> {
    let is = |removed: &&Removed| {
        let name = removed.line.split(' ').next().unwrap_or_default();
        key.strip_prefix(removed.section).and_then(|rest| rest.strip_prefix('.')) == Some(name)
    };
    REMOVED.iter().find(is).map(|removed| removed.instead)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Settings, Source};

    #[test]
    fn settings_of_older_versions_are_read() {
        let text = Settings::default().to_toml();
        assert_eq!(without_removed(&text), text);
        for Removed { section, line, with, instead } in REMOVED {
            let head = format!("[{section}]\n");
            let text = with.map_or_else(|| text.clone(), |with| text.replace("seed_hole = true", with));
            let older = text.replace(&head, &format!("{head}{line}\n"));
            assert_ne!(older, text);
            assert!(toml::from_str::<Settings>(&older).is_err());
            assert_eq!(
                toml::from_str::<Settings>(&without_removed(&older)).expect("settings"),
                toml::from_str::<Settings>(&text).expect("settings")
            );
            // Another section has no such setting.
            assert!(toml::from_str::<Settings>(&without_removed(&format!("{line}\n{text}"))).is_err());
            // Another value asks for what is no more.
            let name = line.split(' ').next().expect("a key");
            let error =
                Settings::resolve(&[Source::Set(format!("{section}.{name}=1e9"))]).expect_err("gone").to_string();
            assert!(error.ends_with(&format!("`{section}.{name}` is gone: {instead}")), "{error}");
        }
    }
}
