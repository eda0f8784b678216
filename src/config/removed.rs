//! Settings of older versions that are gone.

/// A setting that is gone.
struct Removed {
    section: &'static str,
    /// The line that older versions wrote into settings files and checkpoints: the value under which a run goes on as it began.
    line: &'static str,
    /// What to do where it has another value.
    instead: &'static str,
}

const REMOVED: [Removed; 2] = [
    Removed { section: "optimizer", line: "lazy = false", instead: "every parameter is updated in every step" },
    Removed {
        section: "losses.depth",
        line: "reference_inside_region = \"mask\"",
        instead: "the reference's depth weighs more inside the mask; reference_inside_weight says how much",
    },
];

/// Settings as an older version wrote them, with empty lines in place of those that say nothing any more.
pub fn without_removed(text: &str) -> String {
    let mut section = "";
    let mut kept = String::with_capacity(text.len());
    for line in text.split_inclusive('\n') {
        let bare = line.split(" #").next().unwrap_or_default().trim_end();
        if let Some(head) = bare.strip_prefix('[') {
            section = head.trim_end_matches(']');
        }
        let gone = REMOVED.iter().any(|removed| (removed.section, removed.line) == (section, bare));
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
        for Removed { section, line, instead } in REMOVED {
            let head = format!("[{section}]\n");
            let older = text.replace(&head, &format!("{head}{line}\n"));
            assert_ne!(older, text);
            assert!(toml::from_str::<Settings>(&older).is_err());
            assert_eq!(toml::from_str::<Settings>(&without_removed(&older)).expect("settings"), Settings::default());
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
