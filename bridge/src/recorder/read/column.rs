//! What one signal was at each tick, as a recording says it.

/// A row has at most so many axes.
const MAX_AXES: usize = 64;
/// A signal has at most so many names, so that a byte stands for one.
const MAX_NAMES: usize = 256;
/// A name is at most so long, in bytes.
const MAX_NAME: usize = 128;

/// What stands in a column, one value a tick.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Nothing but null.
    Unknown(usize),
    /// As many numbers a tick as there are axes, row by row; null is NaN.
    Axes {
        /// Of all ticks.
        rows: Vec<f64>,
        /// Numbers a tick.
        width: usize,
    },
    /// A number; null is NaN.
    Numbers(Vec<f64>),
    /// A count.
    Counts(Vec<i64>),
    /// Yes or no.
    Flags(Vec<bool>),
    /// A name.
    Names {
        /// Of each tick, its place in `names`.
        codes: Vec<u8>,
        /// In the order in which they first occur.
        names: Vec<String>,
    },
}

/// What a recording says of a signal at a tick, where that is no row of axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Cell<'a> {
    Null,
    Flag(bool),
    Count(i64),
    Number(f64),
    Name(&'a str),
}

impl Cell<'_> {
    /// What it is as a number; a name is none.
    #[allow(clippy::cast_precision_loss)] // a count beyond 2^53 beside fractions is none of ours
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

/// That a value is none of those that a column may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Unfit;

/// A signal of a recording.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    /// Its name.
    pub name: String,
    /// What it is, with its unit, as the file's schema says.
    pub meaning: String,
    /// What it was.
    pub values: Values,
    ticks: usize,
}

impl Column {
    pub(super) fn new(name: String, meaning: String) -> Self {
        Self { name, meaning, values: Values::Unknown(0), ticks: 0 }
    }

    /// Ticks of which it has a value.
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
                // It is mostly that of the tick before.
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

    /// Another kind of values, where what was taken so far is among them, with the cell that it did not fit.
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

    /// Forget what comes after the first `ticks`.
    pub(super) fn truncate(&mut self, ticks: usize) {
        if ticks == 0 {
            // The first value that is kept says of which kind they are.
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
