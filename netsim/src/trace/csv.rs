//! Delays in a CSV file.

use super::MAX_RECORDS;
use super::error::ParseError;
use super::text::{Field, lines};
use crate::settings::{DelayTrace, MAX_DELAY_S, nanoseconds};
use crate::verdict::Direction;

/// Latest time in s.
const LATEST_S: f64 = 1e9;

/// Reads delays of one direction from a CSV file.
///
/// The header is `time_s,delay_s`, or `time_s,forward_delay_s,backward_delay_s` where both directions are in one file;
/// only then does `direction` matter. Times increase. An empty delay, or `lost`, is a lost packet. Lines that begin
/// with `#` and empty lines are left out. At most ten million records.
pub fn parse_delay_csv(bytes: &[u8], direction: Direction) -> Result<DelayTrace, ParseError> {
    let mut time_s = Vec::new();
    let mut delay_s = Vec::new();
    let mut header = None;
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
        if let Some(&before) = time_s.last()
            && nanoseconds(record.time_s) <= nanoseconds(before)
        {
            return Err(line.error(format!(
                "time {} s comes after {before} s; times must increase by 1 ns at least",
                record.time_s
            )));
        }
        if time_s.len() == MAX_RECORDS {
            return Err(line.error(format!("more than {MAX_RECORDS} records")));
        }
        time_s.push(record.time_s);
        delay_s.push(record.delay_s);
    }
    if time_s.is_empty() {
        let missing = if header.is_none() { "no header; it must be time_s,delay_s" } else { "no records" };
        return Err(ParseError::new(last_line, 1, missing));
    }
    Ok(DelayTrace { time_s, delay_s, interpolate: true, repeat: true })
}

/// How many columns there are, and which one is wanted.
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
                0 => record.time_s = field.number("time", 0.0, LATEST_S)?,
                // The other direction is checked too: a file is good or it is not.
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
