//! Lines and fields of text files, with their places.

use super::error::ParseError;

/// Longest line in bytes of a file of numbers.
const LONGEST_LINE: usize = 4096;
/// Most of an unreadable field that is shown.
const SHOWN: usize = 40;

/// A piece of a line, with its place.
#[derive(Clone, Copy, Debug)]
pub(super) struct Field<'a> {
    pub(super) line: usize,
    pub(super) column: usize,
    pub(super) text: &'a str,
}

impl<'a> Field<'a> {
    pub(super) fn error(&self, problem: impl Into<String>) -> ParseError {
        ParseError::new(self.line, self.column, problem)
    }

    /// The text as it is shown in an error.
    pub(super) fn shown(&self) -> String {
        let mut characters = self.text.chars();
        let start: String = characters.by_ref().take(SHOWN).collect();
        if characters.next().is_some() { format!("\"{start}...\"") } else { format!("\"{start}\"") }
    }

    /// Without blanks at both ends.
    pub(super) fn trim(self) -> Self {
        let text = self.text.trim_start();
        let column = self.column + self.text.len() - text.len();
        Self { column, text: text.trim_end(), ..self }
    }

    /// Its parts between commas.
    pub(super) fn commas(self) -> impl Iterator<Item = Field<'a>> {
        let mut column = self.column;
        self.text.split(',').map(move |text| {
            let field = Field { line: self.line, column, text };
            column += text.len() + 1;
            field.trim()
        })
    }

    /// Its parts between blanks.
    pub(super) fn words(self) -> impl Iterator<Item = Field<'a>> {
        let mut rest = self;
        std::iter::from_fn(move || {
            let start = rest.trim();
            if start.text.is_empty() {
                return None;
            }
            let length = start.text.find(char::is_whitespace).unwrap_or(start.text.len());
            let (word, after) = start.text.split_at(length);
            rest = Field { column: start.column + length, text: after, ..start };
            Some(Field { text: word, ..start })
        })
    }

    /// A finite number within a range.
    pub(super) fn number(&self, name: &str, minimum: f64, maximum: f64) -> Result<f64, ParseError> {
        match self.text.parse::<f64>() {
            Ok(number) if (minimum..=maximum).contains(&number) => Ok(number),
            _ => {
                let shown = self.shown();
                Err(self.error(format!("{name} = {shown}: must be a number from {minimum} to {maximum}")))
            }
        }
    }
}

/// The lines of a file; the first error of form ends them.
pub(super) fn lines(bytes: &[u8]) -> impl Iterator<Item = Result<Field<'_>, ParseError>> {
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    let bytes = bytes.strip_suffix(b"\n").unwrap_or(bytes);
    bytes.split(|&byte| byte == b'\n').zip(1..).map(|(bytes, line)| {
        if bytes.len() > LONGEST_LINE {
            let problem = format!("the line has {} bytes; at most {LONGEST_LINE} are allowed", bytes.len());
            return Err(ParseError::new(line, LONGEST_LINE + 1, problem));
        }
        match std::str::from_utf8(bytes) {
            Ok(text) => Ok(Field { line, column: 1, text: text.strip_suffix('\r').unwrap_or(text) }),
            Err(error) => Err(ParseError::new(line, error.valid_up_to() + 1, "not text in UTF-8")),
        }
    })
}
