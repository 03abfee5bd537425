//! Distribution tables of iproute2.

use super::error::ParseError;
use super::text::lines;

/// Most values that netem takes.
const MAX_VALUES: usize = 16_384;

/// Reads a `.dist` table of iproute2: whole numbers from -32768 to 32767 between blanks, 2 to 16384 of them that
/// are not all alike; lines that
/// begin with `#` are left out. They are an inverse distribution function in units of 1/8192 standard deviation.
///
/// `tc` cuts larger numbers off silently and ends a line at what it cannot read; here both are errors.
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
