//! Link traces of mahimahi.

use super::error::ParseError;
use super::text::lines;
use crate::rate::MAX_OPPORTUNITIES;
use crate::settings::Opportunities;

/// Latest time in ms.
const LATEST_MS: u64 = 1_000_000_000_000;

/// Reads a link trace of mahimahi: a whole number of ms on every line, not decreasing, the last above 0.
///
/// As `mm-link` does, it refuses empty lines and knows no comments. At most ten million times.
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
            Ok(ms) if digits && ms <= LATEST_MS => ms,
            _ => {
                let shown = field.shown();
                return Err(
                    field.error(format!("{shown}: must be a whole number of ms from 0 to {LATEST_MS}"))
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
