//! The choices that are compared: names for changes of settings, as data.

use crate::config::{Error, Settings, Source};

/// A choice: its name and the settings that make it. `key=value` is what `--set` takes; `key*=factor` multiplies what the
/// settings say, rounded and at least 1; `key=value%` is that share of all steps.
pub type Choice = (&'static str, &'static [&'static str]);

/// Choices within a step. The first, without a change, is the settings as they are.
pub const KERNELS: &[Choice] = &[
    ("as set", &[]),
    ("no culling", &["render.cull=false"]),
    ("alpha from 1/1000", &["render.alpha_threshold=0.001"]),
    ("alpha from 1/64", &["render.alpha_threshold=0.015625"]),
    ("no early stop", &["render.transmittance_threshold=0.0"]),
    ("attention", &["model.attention.enabled=true"]),
    ("half the tokens", &["model.attention.enabled=true", "model.attention.tokens*=0.5"]),
    ("a quarter of the tokens", &["model.attention.enabled=true", "model.attention.tokens*=0.25"]),
    ("attention written back", &["model.attention.enabled=true", "model.attention.write_back=true"]),
    ("no attention", &["model.attention.enabled=false"]),
    ("depth gradient at one scale", &["losses.depth.gradient.scales=1"]),
    ("no depth gradient", &["losses.depth.gradient.weight=0.0"]),
    ("no depth", &["losses.depth.enabled=false"]),
];

/// However short a run is, two thirds of it have attention, as those of `lavapipe`.
const ATTENTION_START: &str = "model.attention.start=33%";

/// Choices of a whole training run.
pub const TRAINING: &[Choice] = &[
    ("as set", &[]),
    ("attention", &["model.attention.enabled=true", ATTENTION_START]),
    ("a quarter of the tokens", &["model.attention.enabled=true", ATTENTION_START, "model.attention.tokens*=0.25"]),
    ("no attention", &["model.attention.enabled=false"]),
    ("no depth", &["losses.depth.enabled=false"]),
    ("half the resolution", &["scene.downscale*=2"]),
    ("half the resolution in the first half", &["train.coarse.until=50%"]),
];

/// A choice with its settings resolved.
#[derive(Clone, Debug)]
pub struct Variant {
    /// Its name.
    pub name: String,
    /// What is set, as `key=value`.
    pub changes: Vec<String>,
    /// Every setting.
    pub settings: Settings,
}

/// Resolves choices over `sources`, whose settings are `base`.
///
/// # Errors
/// As [`Settings::resolve`]: a change that names no setting, or makes no sense with the others.
pub fn resolve<'a>(
    sources: &[Source],
    base: &Settings,
    choices: impl IntoIterator<Item = (&'a str, Vec<String>)>,
) -> Result<Vec<Variant>, Error> {
    let resolve = |(name, changes): (&str, Vec<String>)| {
        let changes: Vec<String> = changes.iter().map(|change| absolute(base, change)).collect();
        let own = changes.iter().cloned().map(Source::Set);
        let sources: Vec<Source> = sources.iter().cloned().chain(own).collect();
        Ok(Variant { name: name.to_owned(), settings: Settings::resolve(&sources)?, changes })
    };
    choices.into_iter().map(resolve).collect()
}

/// A choice from the command line: `NAME:KEY=VALUE,KEY=VALUE`, where the name may be left out.
pub fn parse(text: &str) -> (String, Vec<String>) {
    let changes = |text: &str| text.split(',').map(|change| change.trim().to_owned()).collect();
    match text.split_once(':') {
        Some((name, rest)) if !name.contains('=') => (name.trim().to_owned(), changes(rest)),
        _ => (text.to_owned(), changes(text)),
    }
}

/// `key*=factor` and `key=value%` as `key=value`; anything else as it is, for [`Settings::resolve`] to judge.
fn absolute(base: &Settings, change: &str) -> String {
    let share = change.split_once('=').and_then(|(key, value)| {
        let share: f64 = value.trim().strip_suffix('%')?.parse().ok()?;
        Some(format!("{key}={}", (f64::from(base.train.iterations) * share / 100.0).round()))
    });
    let found = change.split_once("*=").and_then(|(key, factor)| {
        let table: toml::Value = toml::from_str(&base.to_toml()).ok()?;
        let value = key.trim().split('.').try_fold(&table, |table, key| table.get(key))?;
        let factor: f64 = factor.trim().parse().ok()?;
        match value {
            toml::Value::Integer(value) => Some(format!("{key}={}", (*value as f64 * factor).round().max(1.0))),
            toml::Value::Float(value) => Some(format!("{key}={:?}", value * factor)),
            _ => None,
        }
    });
    share.or(found).unwrap_or_else(|| change.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_choice_resolves() {
        let base = Settings::default();
        for table in [KERNELS, TRAINING] {
            let choices =
                table.iter().map(|(name, changes)| (*name, changes.iter().map(|c| (*c).to_owned()).collect()));
            let variants = resolve(&[], &base, choices).expect("settings that exist");
            assert!(variants[0].changes.is_empty() && variants[0].settings == base);
            // What a part costs is asked with and without it, and the settings have it or not.
            let changes = |variant: &Variant| variant.settings != base || variant.name == "no attention";
            assert!(variants[1..].iter().all(changes), "{variants:#?}");
        }
    }

    #[test]
    fn changes_relative_to_the_settings() {
        let base = Settings::default();
        assert_eq!(absolute(&base, "model.attention.tokens*=0.25"), "model.attention.tokens=500");
        assert_eq!(absolute(&base, "model.attention.tokens*=0.0001"), "model.attention.tokens=1");
        assert_eq!(absolute(&base, "losses.ssim_weight*=0.5"), "losses.ssim_weight=0.1");
        assert_eq!(absolute(&base, "train.coarse.until=50%"), "train.coarse.until=15000");
        for wrong in [
            "model.tokens*=2",
            "model.attention.enabled*=2",
            "model.attention.tokens*=many",
            "train.coarse.until=half%",
        ] {
            let error = resolve(&[], &base, [("wrong", vec![wrong.to_owned()])]);
            assert!(error.is_err(), "{wrong}");
        }
    }

    #[test]
    fn choices_from_the_command_line() {
        let own = |text: &str| parse(text);
        assert_eq!(own("near:render.near=0.1"), ("near".into(), vec!["render.near=0.1".into()]));
        assert_eq!(own("a.b=1, c.d*=2"), ("a.b=1, c.d*=2".into(), vec!["a.b=1".into(), "c.d*=2".into()]));
        assert_eq!(own("a.b=x:y").1, ["a.b=x:y"]);
    }
}
