//! The runs of a judge, kept in one file as they come, and their table.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::{Error, read_json, write_json};
use crate::atomic;
use crate::lab::ablation::{Figure, markdown};
use crate::lab::statistics::Moments;

/// The file of all runs.
pub(crate) const RUNS: &str = "hole.json";
/// The table of them.
pub(crate) const TABLE: &str = "hole.md";

/// A run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Row {
    /// The composed scene.
    pub scene: String,
    /// Of the training.
    pub seed: u64,
    /// Hash of all settings but the seed.
    pub settings: String,
    /// Steps trained.
    pub steps: u32,
    /// Views judged.
    pub views: usize,
    /// Every figure by its name.
    pub figures: BTreeMap<String, Figure>,
}

/// Runs of one build of the program.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct File {
    /// Hash of the program.
    program: String,
    runs: Vec<Row>,
}

/// The runs that are complete.
pub(crate) struct Known {
    path: PathBuf,
    file: File,
}

impl Known {
    /// Those in this folder, for the program of this hash to add to.
    ///
    /// # Errors
    /// A record that is none; one of another build of the program.
    pub(crate) fn read(folder: &Path, program: &str) -> Result<Self, Error> {
        let path = folder.join(RUNS);
        if !path.is_file() {
            return Ok(Self { path, file: File { program: program.to_owned(), runs: vec![] } });
        }
        let refused = |what: &str| Error::Record { path: path.clone(), what: what.to_owned() };
        let file: File = read_json(&path).map_err(|_| refused("holds no runs of bench --hole"))?;
        if file.program != program {
            return Err(refused("holds runs of another build of this program"));
        }
        Ok(Self { path, file })
    }

    /// The run of a scene under a seed.
    ///
    /// # Errors
    /// One that was made with other settings.
    pub(crate) fn find(&self, scene: &str, seed: u64, settings: &str) -> Result<Option<&Row>, Error> {
        let row = self.file.runs.iter().find(|row| row.scene == scene && row.seed == seed);
        match row {
            Some(row) if row.settings != settings => {
                let what = format!("holds a run of {scene} with other settings");
                Err(Error::Record { path: self.path.clone(), what })
            }
            row => Ok(row),
        }
    }

    /// Adds a run, and writes the file and the table.
    ///
    /// # Errors
    /// A folder that cannot be written.
    pub(crate) fn add(&mut self, row: Row) -> Result<(), Error> {
        self.file.runs.push(row);
        write_json(&self.path, &self.file)?;
        let path = self.path.with_file_name(TABLE);
        atomic::write(&path, self.table()).map_err(|source| Error::io(&path, source))
    }

    /// All of them as a table.
    pub(crate) fn table(&self) -> String {
        table(&self.file.runs)
    }
}

/// A column: the figure's name, its title, digits.
type Column = (&'static str, &'static str, usize);

/// Figures of a table, in order; others are in the file alone.
pub(crate) const COLUMNS: [Column; 20] = [
    ("masked_psnr", "masked PSNR", 2),
    ("masked_ssim", "SSIM", 3),
    ("masked_flip", "FLIP", 3),
    ("masked_psnr_worst", "worst view", 2),
    ("seen_psnr", "seen PSNR", 2),
    ("seen_ssim", "SSIM", 3),
    ("seen_flip", "FLIP", 3),
    ("unseen_psnr", "unseen PSNR", 2),
    ("unseen_ssim", "SSIM", 3),
    ("unseen_flip", "FLIP", 3),
    ("seen_share", "seen %", 0),
    ("rim_psnr", "rim PSNR", 2),
    ("outside_psnr", "outside PSNR", 2),
    ("residue", "object left", 3),
    ("residue_worst", "at most", 3),
    ("shadow_levels", "in the shadow, levels", 1),
    ("iou", "masks' IoU", 3),
    ("iou_worst", "least", 3),
    ("prepare_seconds", "prepare s", 0),
    ("train_seconds", "train s", 0),
];

/// By scene over its seeds, and over the scenes. The mean over the scenes is taken seed by seed, over those seeds that every
/// scene has: its deviation is that of a seed.
pub(crate) fn table(rows: &[Row]) -> String {
    let mut scenes: Vec<&str> = vec![];
    for row in rows {
        if !scenes.contains(&row.scene.as_str()) {
            scenes.push(&row.scene);
        }
    }
    let of = |scene: &str| rows.iter().filter(move |row| row.scene == scene).collect::<Vec<&Row>>();
    let columns: Vec<&Column> =
        COLUMNS.iter().filter(|(name, ..)| rows.iter().any(|row| row.figures.contains_key(*name))).collect();
    let cell = |values: &[f64], digits: usize| Moments::of(values).map_or("-".to_owned(), |m| m.text(digits));
    let head = ["scene", "seeds", "views"].into_iter().chain(columns.iter().map(|(_, title, _)| *title));
    let mut lines: Vec<Vec<String>> = vec![head.map(str::to_owned).collect()];
    for scene in &scenes {
        let runs = of(scene);
        let first = [(*scene).to_owned(), runs.len().to_string(), runs[0].views.to_string()];
        let figures = columns.iter().map(|(name, _, digits)| {
            let values: Vec<f64> = runs.iter().filter_map(|row| Some(row.figures.get(*name)?.0)).collect();
            cell(&values, *digits)
        });
        lines.push(first.into_iter().chain(figures).collect());
    }
    let mut seeds: Vec<u64> = rows.iter().map(|row| row.seed).collect();
    seeds.sort_unstable();
    seeds.dedup();
    seeds.retain(|seed| scenes.iter().all(|scene| of(scene).iter().any(|row| row.seed == *seed)));
    if scenes.len() > 1 && !seeds.is_empty() {
        let mean = columns.iter().map(|(name, _, digits)| {
            let by_seed = |seed: &u64| {
                let values: Vec<f64> = rows
                    .iter()
                    .filter(|row| row.seed == *seed)
                    .filter_map(|row| Some(row.figures.get(*name)?.0))
                    .collect();
                (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
            };
            cell(&seeds.iter().filter_map(by_seed).collect::<Vec<_>>(), *digits)
        });
        let first = ["mean".to_owned(), seeds.len().to_string(), String::new()];
        lines.push(first.into_iter().chain(mean).collect());
    }
    let mut text = markdown(lines);
    writeln!(
        text,
        "\nMean ± standard deviation of a seed; means over the views whose masks are not empty. Seen: the true surface behind \
         the object is visible in another photograph outside its true mask. Object left: 0 nothing, 1 all of it."
    )
    .expect("a string takes everything");
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(scene: &str, seed: u64, psnr: f64) -> Row {
        let figures = [("masked_psnr".to_owned(), Figure(psnr))].into();
        Row { scene: scene.into(), seed, settings: "s".into(), steps: 10, views: 4, figures }
    }

    #[test]
    fn it_goes_on_where_it_stopped() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut known = Known::read(folder.path(), "build").expect("no file is no run");
        known.add(row("a", 0, 20.0)).expect("writable");
        known.add(row("a", 1, f64::INFINITY)).expect("writable");
        let again = Known::read(folder.path(), "build").expect("its own file");
        assert_eq!(again.find("a", 1, "s").expect("its settings"), Some(&row("a", 1, f64::INFINITY)));
        assert_eq!(again.find("a", 2, "s").expect("none"), None);
        assert_eq!(again.table(), std::fs::read_to_string(folder.path().join(TABLE)).expect("written with it"));
        let says = |result: Result<Option<&Row>, Error>| result.expect_err("refused").to_string();
        let other = says(again.find("a", 0, "t"));
        assert!(other.ends_with("holds a run of a with other settings; choose another --out"), "{other}");
        let other = Known::read(folder.path(), "later").err().expect("another build").to_string();
        assert!(other.ends_with("holds runs of another build of this program; choose another --out"), "{other}");
        std::fs::write(folder.path().join(RUNS), "[]").expect("writable");
        let none = Known::read(folder.path(), "build").err().expect("no record").to_string();
        assert!(none.ends_with("holds no runs of bench --hole; choose another --out"), "{none}");
    }

    /// Scenes by their seeds; the mean over scenes by the seeds that all have.
    #[test]
    fn the_table_has_means_and_deviations() {
        let rows = [row("a", 0, 20.0), row("a", 1, 22.0), row("b", 0, 10.0)];
        let text = table(&rows);
        let lines: Vec<&str> = text.lines().take(5).collect();
        let expected = [
            "| scene | seeds | views | masked PSNR |",
            "| --- | --- | --- | --- |",
            "| a | 2 | 4 | 21.00 ± 1.41 |",
            "| b | 1 | 4 | 10.00 |",
            "| mean | 1 |  | 15.00 |",
        ];
        assert_eq!(lines, expected);
    }
}
