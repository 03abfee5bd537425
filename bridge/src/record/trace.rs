//! Records of a run as columns, one per field.

use crate::recorder::{Recorded, Value};

/// Values of one field, tick by tick.
#[derive(Clone, Debug, PartialEq)]
pub enum Column {
    /// Vectors of the given length.
    Vectors(usize, Vec<f64>),
    /// Numbers.
    Numbers(Vec<f64>),
    /// Counts.
    Counts(Vec<u64>),
    /// Bits, flags, and codes of names.
    Codes(Vec<u8>),
}

impl Column {
    fn of(value: Value<'_>, ticks: usize) -> Self {
        match value {
            Value::Axes(values) => Self::Vectors(values.len(), Vec::with_capacity(values.len() * ticks)),
            Value::Number(_) => Self::Numbers(Vec::with_capacity(ticks)),
            Value::Count(_) => Self::Counts(Vec::with_capacity(ticks)),
            Value::Bits(_) | Value::Name(_) | Value::Code(..) | Value::Flag(_) => {
                Self::Codes(Vec::with_capacity(ticks))
            }
        }
    }

    fn push(&mut self, value: Value<'_>) {
        match (self, value) {
            (Self::Vectors(_, column), Value::Axes(values)) => column.extend_from_slice(values),
            (Self::Numbers(column), Value::Number(value)) => column.push(value),
            (Self::Counts(column), Value::Count(value)) => column.push(value),
            #[allow(clippy::cast_possible_truncation)] // bits of one byte
            (Self::Codes(column), Value::Bits(bits)) => column.push(bits as u8),
            (Self::Codes(column), Value::Code(code, _)) => column.push(code),
            (Self::Codes(column), Value::Flag(flag)) => column.push(flag.into()),
            // A field has one type in all records; a name without a code has no column.
            _ => {}
        }
    }
}

/// Records of a run as columns.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trace {
    ticks: usize,
    columns: Vec<(&'static str, Column)>,
}

impl Trace {
    /// Columns of `records`.
    pub fn of<R: Recorded>(records: &[R]) -> Self {
        let mut columns = Vec::new();
        R::any().fields(&mut |(name, _, value)| columns.push((name, Column::of(value, records.len()))));
        for record in records {
            push(&mut columns, record);
        }
        Self { ticks: records.len(), columns }
    }

    /// Number of ticks.
    pub fn ticks(&self) -> usize {
        self.ticks
    }

    /// Column of a field; `None` if the records lack it.
    pub fn column(&self, name: &str) -> Option<&Column> {
        self.columns.iter().find(|(known, _)| *known == name).map(|(_, column)| column)
    }
}

/// Add one record; compiled once for all record types.
fn push(columns: &mut [(&'static str, Column)], record: &dyn Recorded) {
    let mut columns = columns.iter_mut();
    record.fields(&mut |(_, _, value)| {
        if let Some((_, column)) = columns.next() {
            column.push(value);
        }
    });
}
