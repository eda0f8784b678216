//! Settings of older versions that are gone.

/// A setting that is gone.
struct Removed {
    section: &'static str,
    name: &'static str,
    /// The values that older versions wrote into settings files and checkpoints under which a run goes on as it began, each
    /// with what else must be set; "" where nothing must.
    kept: &'static [(&'static str, &'static str)],
    /// What to do where it has another value.
    instead: &'static str,
}

/// A row of the table: its section and name, the values that say nothing any more, and what to do instead.
const fn gone(
    [section, name]: [&'static str; 2],
    kept: &'static [(&'static str, &'static str)],
    instead: &'static str,
) -> Removed {
    Removed { section, name, kept, instead }
}

const REMOVED: [Removed; 26] = [
    gone(["optimizer", "lazy"], &[("false", "")], "every parameter is updated in every step"),
    gone(["optimizer", "betas"], &[("[0.9, 0.999]", "")], "Adam's decay rates are 0.9 and 0.999"),
    gone(
        ["optimizer", "schedule_length"],
        &[("0", "")],
        "learning rates reach their end in the last step, train.iterations",
    ),
    gone(["render", "depth_bits"], &[("28", "")], "sort keys have 28 bits of the depth"),
    gone(["train", "background"], &[("[0.0, 0.0, 0.0]", "")], "black is behind the scene"),
    gone(["train.coarse", "factor"], &[("2", "")], "pictures are halved until train.coarse.until"),
    gone(
        ["densify", "growth"],
        &[("0.05", "")],
        "a round adds 5 % of the plain Gaussians, up to densify.max_gaussians",
    ),
    gone(
        ["densify", "coarsest_pixels"],
        &[("0.0", "")],
        "densify.coarsest_cell says it in voxels: so many pixels over model.voxel_pixels",
    ),
    gone(
        ["scene", "seed_behind_edges"],
        &[("true", "scene.seed_hole = true"), ("false", "scene.seed_hole = false")],
        "scene.seed_hole adds the points behind the hole's depth edges, too",
    ),
    gone(
        ["scene", "object_point_share"],
        &[("0.9", "scene.seed_hole = true"), ("1.0", "scene.seed_hole = false")],
        "scene.seed_hole leaves out the points in more than 90 % of their views' masks, too",
    ),
    gone(
        ["scene", "guess_reference_prior"],
        &[("true", "scene.check_priors = true"), ("false", "scene.check_priors = false")],
        "scene.check_priors guesses the depth of an inpainted picture without prior, too",
    ),
    gone(
        ["losses.depth", "align_to_points"],
        &[("true", "scene.check_priors = true"), ("false", "scene.check_priors = false")],
        "scene.check_priors takes the depth of the reference's prior from the points, too",
    ),
    gone(
        ["scene", "outrank_guess"],
        &[("5", "scene.whole_reference = false"), ("0", "scene.whole_reference = true")],
        "five views that see past the object outrank the inpainted picture, unless scene.whole_reference is true",
    ),
    gone(["scene", "grow_masks"], &[("false", "")], "scene.dilate_masks enlarges the masks by so many pixels"),
    gone(["scene", "priors"], &[("true", "")], "scene.prior_folder = \"none\" leaves the depth priors out"),
    gone(["scene", "reference"], &[("true", "")], "scene.reference_file = \"none\" leaves the inpainted picture out"),
    gone(
        ["losses.depth.gradient", "reference_weight"],
        &[("1.0", "")],
        "losses.depth.gradient.weight is the reference's, losses.depth.other_weight the share of it on other views",
    ),
    gone(
        ["losses.depth", "reference_inside_region"],
        &[("\"mask\"", "")],
        "the reference's depth weighs more inside the mask",
    ),
    gone(
        ["losses.depth", "reference_inside_weight"],
        &[("99.0", "")],
        "the reference's depth weighs 100 inside the mask",
    ),
    gone(
        ["losses.depth", "reference_weight"],
        &[("1.0", "")],
        "the reference's depth weighs 1, and 100 inside the mask",
    ),
    gone(
        ["losses", "reference_inside_weight"],
        &[("20.0", "")],
        "inside the mask the reference's colours weigh 20 times what others do",
    ),
    gone(
        ["losses.depth.gradient", "other_weight"],
        &[("0.1", "losses.depth.other_weight = 0.1"), ("0.0", "losses.depth.other_weight = 0.0")],
        "losses.depth.other_weight is the share of the gradient's weight on other views, too",
    ),
    gone(
        ["model", "spread"],
        &[("0.0", "model.color_features = 0.0"), ("0.5", "model.color_features = 1.0")],
        "offsets begin in +- half of model.color_features",
    ),
    gone(
        ["render", "tiles"],
        &[("\"auto\"", "")],
        "tiles have the shape that the device's kernels want; --form chooses these",
    ),
    gone(
        ["train", "save_interval"],
        &[("5000", ""), ("1500", ""), ("0", "")],
        "the model is saved where it is evaluated, every train.eval_interval steps",
    ),
    gone(["densify", "levels"], &[("3", "")], "anchors grow at three levels of the grid"),
];

/// Settings as an older version wrote them, with empty lines in place of those that say nothing any more.
pub fn without_removed(text: &str) -> String {
    let settings: toml::Value = toml::from_str(text).unwrap_or(toml::Value::Boolean(false));
    let mut section = "";
    let mut kept = String::with_capacity(text.len());
    for line in text.split_inclusive('\n') {
        let bare = line.split(" #").next().unwrap_or_default().trim_end();
        if let Some(head) = bare.strip_prefix('[') {
            section = head.trim_end_matches(']');
        }
        let stays = |with: &str| {
            let (key, value) = with.split_once(" = ").unwrap_or_default();
            let found = key.split('.').try_fold(&settings, |table, key| table.get(key));
            with.is_empty() || found.is_some_and(|found| found.to_string() == value)
        };
        let says_nothing = |removed: &Removed| {
            let is =
                |value: &str| bare.strip_prefix(removed.name).and_then(|rest| rest.strip_prefix(" = ")) == Some(value);
            removed.section == section && removed.kept.iter().any(|(value, with)| is(value) && stays(with))
        };
        let gone = REMOVED.iter().any(says_nothing);
        kept += if gone { "\n" } else { line };
    }
    kept
}

/// What to do in place of a setting that is gone, by its dotted key.
pub(super) fn instead(key: &str) -> Option<&'static str> {
    let is = |removed: &&Removed| key.rsplit_once('.') == Some((removed.section, removed.name));
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
        let rows = REMOVED.iter().flat_map(|row| row.kept.iter().map(move |(value, with)| (row, value, with)));
        for (Removed { section, name, instead, .. }, value, with) in rows {
            let (head, line) = (format!("[{section}]\n"), format!("{name} = {value}"));
            // Settings that have what is needed.
            let sources: Vec<Source> = Some(with)
                .filter(|with| !with.is_empty())
                .map(|with| Source::Set((*with).to_owned()))
                .into_iter()
                .collect();
            let text = Settings::resolve(&sources).expect("settings").to_toml();
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
            let error =
                Settings::resolve(&[Source::Set(format!("{section}.{name}=1e9"))]).expect_err("gone").to_string();
            assert!(error.ends_with(&format!("`{section}.{name}` is gone: {instead}")), "{error}");
        }
    }
}
