use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::Deserialize;
use toml::de::{DeTable, DeValue};
use toml::{Spanned, Table, Value};

use super::removed::{instead, without_removed};
use super::{CHANGES, Error, Invalid, Origin, PRESETS, Settings, Source};

/// The layers laid over each other so far, and who set each key.
#[derive(Default)]
pub(super) struct Layers {
    merged: Table,
    origins: BTreeMap<String, Origin>,
}

/// Where a layer's text comes from, before a line is known.
enum Place {
    File(PathBuf),
    Preset(String),
    Set(String),
    Flag(&'static str),
}

impl Place {
    fn at(&self, text: &str, offset: usize) -> Origin {
        let line = 1 + text.bytes().take(offset).filter(|byte| *byte == b'\n').count();
        match self {
            Self::File(path) => Origin::File { path: path.clone(), line },
            Self::Preset(name) => Origin::Preset { name: name.clone(), line },
            Self::Set(text) => Origin::Set(text.clone()),
            Self::Flag(flag) => Origin::Flag(flag),
        }
    }
}

impl Layers {
    pub(super) fn push(&mut self, source: &Source) -> Result<(), Error> {
        match source {
            Source::Preset(name) => {
                let (_, text) = PRESETS
                    .iter()
                    .find(|(known, _)| known == name)
                    .ok_or_else(|| Error::UnknownPreset { name: name.clone() })?;
                if name == CHANGES.0 {
                    self.push(&Source::Preset(CHANGES.1.into()))?;
                }
                self.push_text(text, &Place::Preset(name.clone()))
            }
            Source::File(path) => {
                let text =
                    std::fs::read_to_string(path).map_err(|source| Error::Read { path: path.clone(), source })?;
                self.push_text(&without_removed(&text), &Place::File(path.clone()))
            }
            Source::Set(text) => self.push_text(&set_as_toml(text)?, &Place::Set(text.clone())),
            Source::Flag { flag, key, value } => self.push_text(&format!("{key} = {value}"), &Place::Flag(flag)),
        }
    }

    fn push_text(&mut self, text: &str, place: &Place) -> Result<(), Error> {
        let start = |error: &toml::de::Error| error.span().map_or(0, |span| span.start);
        let syntax = |error: toml::de::Error| Error::Syntax {
            origin: place.at(text, start(&error)),
            message: one_line(error.message()),
        };
        let tree = DeTable::parse(text).map_err(syntax)?;
        let table: Table = toml::from_str(text).map_err(syntax)?;
        // The layer alone must be settings: only here does an error still know its line.
        toml::from_str::<Settings>(text)
            .map_err(|error| explain(&error, tree.get_ref(), place.at(text, start(&error))))?;
        note_origins(tree.get_ref(), "", &mut |key, offset| {
            self.origins.insert(key, place.at(text, offset));
        });
        merge(&mut self.merged, table);
        Ok(())
    }

    pub(super) fn settings(&self) -> Result<Settings, Error> {
        Settings::deserialize(self.merged.clone()).map_err(|error| Error::Type {
            origin: Origin::Default,
            key: String::new(),
            message: one_line(error.message()),
        })
    }

    /// Names the layer that set the refused key.
    pub(super) fn blame(&self, invalid: Invalid) -> Error {
        let keys = [Some(&invalid.key), invalid.against.as_ref()];
        let origin = keys.into_iter().flatten().find_map(|key| self.origins.get(key)).cloned();
        let origin = origin.unwrap_or(Origin::Default);
        Error::Invalid { origin, invalid: Box::new(invalid) }
    }
}

/// `key=value` as a TOML document; a value that is not TOML becomes a string.
fn set_as_toml(text: &str) -> Result<String, Error> {
    let (key, value) = text.split_once('=').ok_or_else(|| Error::Set { text: text.to_owned() })?;
    let (key, value) = (key.trim(), value.trim());
    let bare = |part: &str| !part.is_empty() && part.chars().all(|c| c.is_ascii_alphanumeric() || "_-".contains(c));
    if !key.split('.').all(bare) {
        return Err(Error::Set { text: text.to_owned() });
    }
    let value = match DeValue::parse(value) {
        Ok(_) => value.to_owned(),
        Err(_) => Value::String(value.to_owned()).to_string(),
    };
    Ok(format!("{key} = {value}"))
}

fn merge(into: &mut Table, layer: Table) {
    for (key, value) in layer {
        match (into.get_mut(&key), value) {
            (Some(Value::Table(below)), Value::Table(above)) => merge(below, above),
            (_, value) => {
                into.insert(key, value);
            }
        }
    }
}

fn join(prefix: &str, key: &str) -> String {
    if prefix.is_empty() { key.to_owned() } else { format!("{prefix}.{key}") }
}

fn note_origins(table: &DeTable<'_>, prefix: &str, note: &mut impl FnMut(String, usize)) {
    for (key, value) in table {
        let path = join(prefix, key.get_ref());
        match value.get_ref() {
            DeValue::Table(inner) => note_origins(inner, &path, note),
            _ => note(path, key.span().start),
        }
    }
}

/// The dotted key that covers a byte of the text.
fn key_at(table: &DeTable<'_>, prefix: &str, offset: usize) -> Option<String> {
    for (key, value) in table {
        let path = join(prefix, key.get_ref());
        if key.span().contains(&offset) {
            return Some(path);
        }
        let inner = value.get_ref().as_table().and_then(|inner| key_at(inner, &path, offset));
        if inner.is_some() {
            return inner;
        }
        if Spanned::span(value).contains(&offset) {
            return Some(path);
        }
    }
    None
}

fn explain(error: &toml::de::Error, tree: &DeTable<'_>, origin: Origin) -> Error {
    let key = error.span().and_then(|span| key_at(tree, "", span.start)).unwrap_or_default();
    match error.message().strip_prefix("unknown field `") {
        Some(_) if let Some(instead) = instead(&key) => Error::Removed { origin, key, instead },
        Some(rest) => {
            // Serde's wording: "unknown field `a`, expected one of `b`, `c`".
            let mut quoted = rest.split('`');
            let name = quoted.next().unwrap_or_default();
            let siblings: Vec<&str> = quoted.skip(1).step_by(2).collect();
            let section = key.strip_suffix(name).unwrap_or_default().trim_end_matches('.');
            let hint = hint(section, name, &siblings);
            Error::UnknownKey { origin, key, hint }
        }
        None => Error::Type { origin, key, message: one_line(error.message()) },
    }
}

/// The nearest key of the same section, the same name in another section, or all keys of the section.
fn hint(section: &str, name: &str, siblings: &[&str]) -> String {
    let near = |a: &str, b: &str| strsim::damerau_levenshtein(a, b) <= (b.len() / 3).max(1);
    let sibling =
        siblings.iter().filter(|known| near(name, known)).min_by_key(|known| strsim::damerau_levenshtein(name, known));
    if let Some(known) = sibling {
        return format!("did you mean `{}`?", join(section, known));
    }
    let elsewhere = default_keys()
        .into_iter()
        .filter(|path| near(name, path.rsplit('.').next().unwrap_or(path)))
        .min_by_key(|path| strsim::damerau_levenshtein(&join(section, name), path));
    if let Some(path) = elsewhere {
        return format!("did you mean `{path}`?");
    }
    let place = if section.is_empty() { "the sections are".to_owned() } else { format!("`{section}` has") };
    format!("{place} {}", siblings.join(", "))
}

/// Every key of the default settings, dotted from the root.
fn default_keys() -> Vec<String> {
    let text = Settings::default().to_toml();
    let tree = DeTable::parse(&text).expect("serialised settings are TOML");
    let mut keys = Vec::new();
    note_origins(tree.get_ref(), "", &mut |key, _| keys.push(key));
    keys
}

fn one_line(message: &str) -> String {
    message.lines().collect::<Vec<_>>().join(" ")
}
