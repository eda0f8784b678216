//! Settings of older versions that are gone.

/// Lines that older versions wrote into settings files and checkpoints, each with its section: of settings that are gone, at
/// the value under which a run goes on as it began.
const REMOVED: [(&str, &str); 1] = [("[optimizer]", "lazy = false")];

/// Settings as an older version wrote them, with empty lines in place of those that say nothing any more.
pub fn without_removed(text: &str) -> String {
    let mut section = "";
    let mut kept = String::with_capacity(text.len());
    for line in text.split_inclusive('\n') {
        let bare = line.trim_end();
        if bare.starts_with('[') {
            section = bare;
        }
        kept += if REMOVED.contains(&(section, bare)) { "\n" } else { line };
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Settings;

    #[test]
    fn settings_of_older_versions_are_read() {
        let text = Settings::default().to_toml();
        let older = text.replace("[optimizer]\n", "[optimizer]\nlazy = false\n");
        assert_ne!(older, text);
        assert!(toml::from_str::<Settings>(&older).is_err());
        assert_eq!(toml::from_str::<Settings>(&without_removed(&older)).expect("settings"), Settings::default());
        assert_eq!(without_removed(&text), text);
        // Another value asks for what is no more; another section has no such setting.
        for other in [older.replace("lazy = false", "lazy = true"), format!("lazy = false\n{text}")] {
            assert!(toml::from_str::<Settings>(&without_removed(&other)).is_err());
        }
    }
}
