//! Text files of recordings: delays as CSV, mahimahi link traces, iproute2 distribution tables.

use super::{DelayTrace, MAX_RECORDS};
use crate::checks::{MAX_DELAY_S, MAX_TIME_S, nanoseconds};
use crate::impairments::rate::{MAX_OPPORTUNITIES, Opportunities};
use crate::packet::Direction;

/// Error in a text file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}, column {column}: {problem}")]
pub struct ParseError {
    /// Line, from 1.
    pub line: usize,
    /// Column in bytes, from 1.
    pub column: usize,
    /// Problem and remedy.
    pub problem: String,
}

impl ParseError {
    pub(crate) fn new(line: usize, column: usize, problem: impl Into<String>) -> Self {
        Self { line, column, problem: problem.into() }
    }
}

/// Read delays of one direction from a CSV file.
///
/// The header is `time_s,delay_s`, or `time_s,forward_delay_s,backward_delay_s` for both directions; only
/// then does `direction` matter. Names and numbers may be quoted. Times increase from any first time, which
/// becomes 0. An empty delay, or `lost`, is a lost packet. Empty lines and lines that begin with `#` are
/// skipped. At most ten million records.
pub fn parse_delay_csv(bytes: &[u8], direction: Direction) -> Result<DelayTrace, ParseError> {
    let mut time_s: Vec<f64> = Vec::new();
    let mut delay_s = Vec::new();
    let (mut header, mut first_s) = (None, None);
    let mut last_line = 1;
    for line in lines(bytes) {
        let line = line?.trim();
        last_line = line.line;
        if line.text.is_empty() || line.text.starts_with('#') {
            continue;
        }
        let Some(columns) = header else {
            header = Some(read_header(line, direction)?);
            continue;
        };
        let record = Record::read(line, columns)?;
        let first_s = *first_s.get_or_insert(record.time_s);
        let since_s = record.time_s - first_s;
        if let Some(&before_s) = time_s.last()
            && (since_s < before_s || nanoseconds(since_s) <= nanoseconds(before_s))
        {
            return Err(line.error(format!(
                "time {} s comes after {} s; times must increase by 1 ns at least",
                record.time_s,
                first_s + before_s
            )));
        }
        if since_s > MAX_TIME_S {
            return Err(line.error(format!(
                "time {} s is more than {MAX_TIME_S} s after the first, {first_s} s",
                record.time_s
            )));
        }
        if time_s.len() == MAX_RECORDS {
            return Err(line.error(format!("more than {MAX_RECORDS} records")));
        }
        time_s.push(since_s);
        delay_s.push(record.delay_s);
    }
    if time_s.is_empty() {
        let missing = if header.is_none() { "no header; it must be time_s,delay_s" } else { "no records" };
        return Err(ParseError::new(last_line, 1, missing));
    }
    Ok(DelayTrace { time_s, delay_s, interpolate: true, repeat: true })
}

const MAX_CLOCK_S: f64 = 1e12;

/// Number of columns, and the column to read.
#[derive(Clone, Copy, Debug)]
struct Columns {
    count: usize,
    delay: usize,
}

fn read_header(line: Field<'_>, direction: Direction) -> Result<Columns, ParseError> {
    let names: Vec<&str> = line.commas().map(|field| field.text).take(4).collect();
    match names.as_slice() {
        ["time_s", "delay_s"] => Ok(Columns { count: 2, delay: 1 }),
        ["time_s", "forward_delay_s", "backward_delay_s"] => {
            let delay = match direction {
                Direction::Forward => 1,
                Direction::Backward => 2,
            };
            Ok(Columns { count: 3, delay })
        }
        _ => Err(line.error(format!(
            "{} is no header; it must be time_s,delay_s or time_s,forward_delay_s,backward_delay_s",
            line.shown()
        ))),
    }
}

#[derive(Clone, Copy, Debug)]
struct Record {
    time_s: f64,
    delay_s: Option<f64>,
}

impl Record {
    fn read(line: Field<'_>, columns: Columns) -> Result<Self, ParseError> {
        let mut record = Self { time_s: 0.0, delay_s: None };
        let mut seen = 0;
        for field in line.commas() {
            match seen {
                0 => record.time_s = field.number("time", -MAX_CLOCK_S, MAX_CLOCK_S)?,
                // Check the other direction too: a file is either valid or invalid.
                position => {
                    let delay_s = match field.text {
                        "" | "lost" => None,
                        _ => Some(field.number("delay", 0.0, MAX_DELAY_S)?),
                    };
                    if position == columns.delay {
                        record.delay_s = delay_s;
                    }
                }
            }
            seen += 1;
            if seen > columns.count {
                return Err(field.error(format!("more than {} fields", columns.count)));
            }
        }
        if seen < columns.count {
            let end = Field { column: line.column + line.text.len(), ..line };
            return Err(end.error(format!("{seen} fields; there must be {}", columns.count)));
        }
        Ok(record)
    }
}

const MAX_TIME_MS: u64 = 1_000_000_000_000;

/// Read a mahimahi link trace: a whole number of ms per line, not decreasing, the last above 0.
///
/// Like `mm-link`, it rejects empty lines and comments. At most ten million times.
///
/// Source: `mm-link(1)` of mahimahi, and its reader's behaviour.
pub fn parse_mahimahi(bytes: &[u8]) -> Result<Opportunities, ParseError> {
    let mut time_ms: Vec<u64> = Vec::new();
    let mut last_line = 1;
    for line in lines(bytes) {
        let line = line?;
        last_line = line.line;
        let field = line.trim();
        let digits = field.text.bytes().all(|byte| byte.is_ascii_digit());
        let ms = match field.text.parse::<u64>() {
            Ok(ms) if digits && ms <= MAX_TIME_MS => ms,
            _ => {
                let shown = field.shown();
                return Err(
                    field.error(format!("{shown}: must be a whole number of ms from 0 to {MAX_TIME_MS}"))
                );
            }
        };
        if let Some(&before) = time_ms.last()
            && ms < before
        {
            return Err(field.error(format!("{ms} ms comes after {before} ms; times must not decrease")));
        }
        if time_ms.len() == MAX_OPPORTUNITIES {
            return Err(field.error(format!("more than {MAX_OPPORTUNITIES} times")));
        }
        time_ms.push(ms);
    }
    if time_ms.last() == Some(&0) {
        return Err(ParseError::new(last_line, 1, "the last time is 0 ms; a trace must take some time"));
    }
    Ok(Opportunities { time_ms })
}

/// Maximum of netem.
const MAX_VALUES: usize = 16_384;

/// Read an iproute2 `.dist` table: an inverse distribution function in units of 1/8192 standard deviation.
///
/// It consists of 2 to 16384 whole numbers from -32768 to 32767, not all equal, separated by blanks. Lines
/// that begin with `#` are skipped. `tc` silently truncates larger numbers, and stops reading a line at an
/// invalid word; here both are errors.
///
/// Source: `tc-netem(8)`; `get_distribution` of iproute2 (`MAX_DIST`).
pub fn parse_dist(bytes: &[u8]) -> Result<Vec<i16>, ParseError> {
    let mut table = Vec::new();
    let mut last_line = 1;
    for line in lines(bytes) {
        let line = line?;
        last_line = line.line;
        if line.text.starts_with('#') {
            continue;
        }
        for word in line.words() {
            let Ok(value) = word.text.parse::<i16>() else {
                let shown = word.shown();
                return Err(word.error(format!("{shown}: must be a whole number from -32768 to 32767")));
            };
            if table.len() == MAX_VALUES {
                return Err(word.error(format!("more than {MAX_VALUES} values")));
            }
            table.push(value);
        }
    }
    let Some(first) = table.first() else {
        return Err(ParseError::new(last_line, 1, "no values"));
    };
    if table.iter().all(|value| value == first) {
        return Err(ParseError::new(
            last_line,
            1,
            format!("all values are {first}: at least two must differ"),
        ));
    }
    Ok(table)
}

const MAX_LINE_BYTES: usize = 4096;
/// Maximum number of characters of an invalid field in an error.
const SHOWN: usize = 40;

/// Part of a line, and its position.
#[derive(Clone, Copy, Debug)]
struct Field<'a> {
    line: usize,
    column: usize,
    text: &'a str,
}

impl<'a> Field<'a> {
    fn error(&self, problem: impl Into<String>) -> ParseError {
        ParseError::new(self.line, self.column, problem)
    }

    fn shown(&self) -> String {
        let mut characters = self.text.chars();
        let start: String = characters.by_ref().take(SHOWN).collect();
        if characters.next().is_some() { format!("\"{start}...\"") } else { format!("\"{start}\"") }
    }

    fn trim(self) -> Self {
        let text = self.text.trim_start();
        let column = self.column + self.text.len() - text.len();
        Self { column, text: text.trim_end(), ..self }
    }

    /// Remove enclosing quotes, as spreadsheets write them.
    fn unquoted(self) -> Self {
        match self.text.strip_prefix('"').and_then(|text| text.strip_suffix('"')) {
            Some(text) => Self { column: self.column + 1, text, ..self }.trim(),
            None => self,
        }
    }

    fn commas(self) -> impl Iterator<Item = Field<'a>> {
        let mut column = self.column;
        self.text.split(',').map(move |text| {
            let field = Field { line: self.line, column, text };
            column += text.len() + 1;
            field.trim().unquoted()
        })
    }

    fn words(self) -> impl Iterator<Item = Field<'a>> {
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

    fn number(&self, name: &str, minimum: f64, maximum: f64) -> Result<f64, ParseError> {
        match self.text.parse::<f64>() {
            Ok(number) if (minimum..=maximum).contains(&number) => Ok(number),
            _ => {
                let shown = self.shown();
                Err(self.error(format!("{name} = {shown}: must be a number from {minimum} to {maximum}")))
            }
        }
    }
}

/// Lines of a file; the first format error is returned as an item.
fn lines(bytes: &[u8]) -> impl Iterator<Item = Result<Field<'_>, ParseError>> {
    let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
    let bytes = bytes.strip_suffix(b"\n").unwrap_or(bytes);
    bytes.split(|&byte| byte == b'\n').zip(1..).map(|(bytes, line)| {
        if bytes.len() > MAX_LINE_BYTES {
            let problem = format!("the line has {} bytes; at most {MAX_LINE_BYTES} are allowed", bytes.len());
            return Err(ParseError::new(line, MAX_LINE_BYTES + 1, problem));
        }
        match std::str::from_utf8(bytes) {
            Ok(text) => Ok(Field { line, column: 1, text: text.strip_suffix('\r').unwrap_or(text) }),
            Err(error) => Err(ParseError::new(line, error.valid_up_to() + 1, "not text in UTF-8")),
        }
    })
}
