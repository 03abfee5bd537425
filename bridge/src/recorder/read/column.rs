//! Values of one recorded signal, with one value per tick.

/// Largest number of axes of a row.
const MAX_AXES: usize = 64;
/// Largest number of names of a signal, so that a byte can code them.
const MAX_NAMES: usize = 256;
/// Largest length of a name in bytes.
const MAX_NAME: usize = 128;

/// Values of a column, one per tick.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Only nulls; their number.
    Unknown(usize),
    /// A row of numbers per tick, one for each axis; null is NaN.
    Axes {
        /// Rows of all ticks.
        rows: Vec<f64>,
        /// Numbers per tick.
        width: usize,
    },
    /// Numbers; null is NaN.
    Numbers(Vec<f64>),
    /// Counts.
    Counts(Vec<i64>),
    /// Booleans.
    Flags(Vec<bool>),
    /// Names.
    Names {
        /// Index into `names` for each tick.
        codes: Vec<u8>,
        /// Names in the order of their first occurrence.
        names: Vec<String>,
    },
}

/// Recorded value of a signal at a tick, if it is not a row of axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Cell<'a> {
    Null,
    Flag(bool),
    Count(i64),
    Number(f64),
    Name(&'a str),
}

impl Cell<'_> {
    /// Return the value as a number; None for a name.
    #[allow(clippy::cast_precision_loss)] // recorders write no count above 2^53 beside fractions
    fn number(self) -> Option<f64> {
        match self {
            Self::Null => Some(f64::NAN),
            Self::Flag(value) => Some(f64::from(u8::from(value))),
            Self::Count(value) => Some(value as f64),
            Self::Number(value) => Some(value),
            Self::Name(_) => None,
        }
    }
}

/// Error of a value that does not fit into a column.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Unfit;

/// Signal of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// Name.
    pub name: String,
    /// Meaning with unit, from the schema of the file.
    pub meaning: String,
    /// Values.
    pub values: Values,
    ticks: usize,
}

impl Column {
    pub(super) fn new(name: String, meaning: String) -> Self {
        Self { name, meaning, values: Values::Unknown(0), ticks: 0 }
    }

    /// Return the number of ticks with a value.
    pub(super) fn ticks(&self) -> usize {
        self.ticks
    }

    /// Take the value of the next tick.
    pub(super) fn push(&mut self, cell: Cell<'_>) -> Result<(), Unfit> {
        match (&mut self.values, cell) {
            (Values::Unknown(ticks), Cell::Null) => *ticks += 1,
            (Values::Numbers(numbers), cell) => numbers.push(cell.number().ok_or(Unfit)?),
            (Values::Counts(counts), Cell::Count(value)) => counts.push(value),
            (Values::Flags(flags), Cell::Flag(value)) => flags.push(value),
            (Values::Names { codes, names }, Cell::Name(name)) => {
                // The name is usually that of the last tick.
                let before = codes.last().copied();
                let code = match before.filter(|code| names[usize::from(*code)] == name) {
                    Some(code) => code,
                    None => code_of(names, name)?,
                };
                codes.push(code);
            }
            (_, cell) => self.become_fit_for(cell)?,
        }
        self.ticks += 1;
        Ok(())
    }

    /// Convert the values to another kind that can hold them and `cell`, and add `cell`.
    fn become_fit_for(&mut self, cell: Cell<'_>) -> Result<(), Unfit> {
        self.values = match (&self.values, cell) {
            (Values::Unknown(0), Cell::Flag(value)) => Values::Flags(vec![value]),
            (Values::Unknown(0), Cell::Count(value)) => Values::Counts(vec![value]),
            (Values::Unknown(0), Cell::Name(name)) => {
                let mut names = Vec::new();
                Values::Names { codes: vec![code_of(&mut names, name)?], names }
            }
            (Values::Unknown(ticks), cell) => {
                let number = cell.number().ok_or(Unfit)?;
                let mut numbers = vec![f64::NAN; *ticks];
                numbers.push(number);
                Values::Numbers(numbers)
            }
            (Values::Counts(counts), Cell::Null | Cell::Number(_)) => {
                let mut numbers: Vec<f64> = counts.iter().map(|&count| count as f64).collect();
                numbers.push(cell.number().ok_or(Unfit)?);
                Values::Numbers(numbers)
            }
            (Values::Flags(flags), Cell::Null) => {
                let mut numbers: Vec<f64> = flags.iter().map(|&flag| f64::from(u8::from(flag))).collect();
                numbers.push(f64::NAN);
                Values::Numbers(numbers)
            }
            _ => return Err(Unfit),
        };
        Ok(())
    }

    /// Take the row of the next tick, number by number.
    pub(super) fn push_row<E>(
        &mut self,
        mut next: impl FnMut() -> Result<Option<f64>, E>,
    ) -> Result<Result<(), Unfit>, E> {
        if matches!(self.values, Values::Unknown(0)) {
            let mut rows = Vec::new();
            while let Some(number) = next()? {
                if rows.len() == MAX_AXES {
                    return Ok(Err(Unfit));
                }
                rows.push(number);
            }
            let width = rows.len();
            self.values = Values::Axes { rows, width };
        } else {
            let Values::Axes { rows, width } = &mut self.values else { return Ok(Err(Unfit)) };
            let mut count = 0;
            while let Some(number) = next()? {
                if count == *width {
                    return Ok(Err(Unfit));
                }
                rows.push(number);
                count += 1;
            }
            if count != *width {
                return Ok(Err(Unfit));
            }
        }
        self.ticks += 1;
        Ok(Ok(()))
    }

    /// Remove all values after the first `ticks`.
    pub(super) fn truncate(&mut self, ticks: usize) {
        if ticks == 0 {
            // The first value determines the kind of values again.
            self.values = Values::Unknown(0);
        }
        match &mut self.values {
            Values::Unknown(count) => *count = ticks.min(*count),
            Values::Axes { rows, width } => rows.truncate(ticks * *width),
            Values::Numbers(numbers) => numbers.truncate(ticks),
            Values::Counts(counts) => counts.truncate(ticks),
            Values::Flags(flags) => flags.truncate(ticks),
            Values::Names { codes, .. } => codes.truncate(ticks),
        }
        self.ticks = self.ticks.min(ticks);
    }
}

fn code_of(names: &mut Vec<String>, name: &str) -> Result<u8, Unfit> {
    let place = names.iter().position(|known| known == name).unwrap_or(names.len());
    if place == names.len() {
        if place == MAX_NAMES || name.len() > MAX_NAME {
            return Err(Unfit);
        }
        names.push(name.to_owned());
    }
    u8::try_from(place).map_err(|_| Unfit)
}
