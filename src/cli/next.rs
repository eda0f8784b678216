//! The last lines of a command: what to do next.

use std::path::Path;

/// Says on stderr what can be done next: commands or files, and what they are for.
pub(super) fn say(steps: &[(String, &str)]) {
    eprint!("{}", lines(steps));
}

fn lines(steps: &[(String, &str)]) -> String {
    let width = steps.iter().map(|(what, _)| what.chars().count()).max().unwrap_or(0);
    let line = |(i, (what, purpose)): (usize, &(String, &str))| {
        let head = if i == 0 { "next:" } else { "" };
        format!("{head:5} {what:width$}  {purpose}\n")
    };
    steps.iter().enumerate().map(line).collect()
}

/// A command of this program, as it is typed.
pub(super) fn command(words: &[&str], path: &Path) -> String {
    let path = typed(&path.to_string_lossy());
    std::iter::once("gscream-vk").chain(words.iter().copied()).chain([path.as_str()]).collect::<Vec<_>>().join(" ")
}

/// A word in quotes, where a shell would take it apart.
pub(super) fn typed(word: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "-_=.,/:+".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', "'\\''"))
    }
}

/// The command line without the place of the program.
pub(super) fn command_line() -> String {
    let arguments = std::env::args_os().skip(1).map(|word| typed(&word.to_string_lossy()));
    std::iter::once("gscream-vk".to_owned()).chain(arguments).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_can_be_pasted() {
        assert_eq!(command(&["export"], Path::new("runs/garden")), "gscream-vk export runs/garden");
        assert_eq!(command(&["export"], Path::new("my run's")), "gscream-vk export 'my run'\\''s'");
        assert_eq!(typed(""), "''");
    }

    #[test]
    fn purposes_stand_in_a_column() {
        let steps = [("a b".to_owned(), "one"), ("a".to_owned(), "two")];
        assert_eq!(lines(&steps), "next: a b  one\n      a    two\n");
        assert_eq!(lines(&[]), "");
    }
}
