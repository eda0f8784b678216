//! Words of files within messages.

/// Most characters of one part of a message.
const MAX_CHARACTERS: usize = 1000;

/// The text on one line, for a message: line breaks become spaces, other control characters are escaped, and a text of more
/// than 1000 characters loses its middle. Files may say anything, and parsers repeat it.
pub(crate) fn one_line(text: &str) -> String {
    let mut line = String::new();
    for character in text.trim_end().chars() {
        match character {
            '\n' | '\r' | '\t' | '\u{2028}' | '\u{2029}' => {
                if !line.ends_with(' ') {
                    line.push(' ');
                }
            }
            control if control.is_control() => line.extend(control.escape_default()),
            other => line.push(other),
        }
    }
    let count = line.chars().count();
    if count <= MAX_CHARACTERS {
        return line;
    }
    let head: String = line.chars().take(MAX_CHARACTERS / 2).collect();
    let tail: String = line.chars().skip(count - MAX_CHARACTERS / 2).collect();
    format!("{head} ... {tail}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whatever_a_file_says_is_one_short_line() {
        assert_eq!(one_line("as it is: äß 'x'"), "as it is: äß 'x'");
        assert_eq!(one_line("no PLY\n\tString: 'a'\r\n"), "no PLY String: 'a'");
        assert_eq!(one_line("a\u{1b}[31m\0b"), "a\\u{1b}[31m\\u{0}b");
        let long = one_line(&format!("begins {} ends", "a\u{7}".repeat(50_000)));
        assert!(
            long.starts_with("begins a\\u{7}") && long.ends_with("} ends") && long.chars().count() == 1005,
            "{long}"
        );
    }
}
