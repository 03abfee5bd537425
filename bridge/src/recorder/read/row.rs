//! Parser of a recorded message, directly into the columns of its signals.

use std::{collections::HashMap, fmt};

use serde::de::{DeserializeSeed, Deserializer, Error, IgnoredAny, MapAccess, SeqAccess, Visitor};

use super::column::{Cell, Column, Unfit, Values};

/// Signal with the ns since the run began.
pub(super) const TIME: &str = "time_ns";

/// Signals of a recording, tick by tick.
#[derive(Debug, Default)]
pub(super) struct Table {
    pub(super) columns: Vec<Column>,
    pub(super) ticks: usize,
    places: HashMap<String, usize>,
    /// Index of the column of times, if the schema has one.
    time: Option<usize>,
    /// Columns in the order of the last message; the next message usually has the same order.
    order: Vec<usize>,
}

impl Table {
    pub(super) fn new(columns: Vec<Column>) -> Self {
        let place = |(place, column): (usize, &Column)| (column.name.clone(), place);
        let places: HashMap<_, _> = columns.iter().enumerate().map(place).collect();
        let time = places.get(TIME).copied();
        Self { columns, ticks: 0, places, time, order: Vec::new() }
    }

    /// Take the message of the next tick, or nothing if it does not fit. Signals that it does not name are null.
    pub(super) fn push(&mut self, message: &[u8]) -> bool {
        let mut json = serde_json::Deserializer::from_slice(message);
        let is_taken =
            Row(self).deserialize(&mut json).is_ok() && json.end().is_ok() && self.fill() && self.is_later();
        if is_taken {
            self.ticks += 1;
        } else {
            let ticks = self.ticks;
            self.columns.iter_mut().for_each(|column| column.truncate(ticks));
        }
        is_taken
    }

    /// Return true if the time of the new tick is a count of 0 or more, after that of the last tick.
    fn is_later(&self) -> bool {
        let Some(place) = self.time else { return true };
        let Values::Counts(times) = &self.columns[place].values else { return false };
        let before = self.ticks.checked_sub(1).map_or(-1, |before| times[before]);
        times[self.ticks] > before
    }

    fn fill(&mut self) -> bool {
        let ticks = self.ticks;
        let mut missing = self.columns.iter_mut().filter(|column| column.ticks() == ticks);
        missing.all(|column| column.push(Cell::Null).is_ok())
    }

    /// Return the column of the `nth` signal of a message; none if the schema does not have it.
    fn place(&mut self, nth: usize, name: &str) -> Option<usize> {
        if let Some(&place) = self.order.get(nth)
            && self.columns[place].name == name
        {
            return Some(place);
        }
        let place = *self.places.get(name)?;
        self.order.truncate(nth);
        if self.order.len() == nth {
            self.order.push(place);
        }
        Some(place)
    }
}

/// One message.
struct Row<'a>(&'a mut Table);

impl<'de> DeserializeSeed<'de> for Row<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for Row<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("one object a tick")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<(), A::Error> {
        let mut nth = 0;
        while let Some(place) = map.next_key_seed(Place { table: &mut *self.0, nth })? {
            if let Some(place) = place {
                nth += 1;
                let ticks = self.0.ticks;
                let column = &mut self.0.columns[place];
                if column.ticks() != ticks {
                    return Err(A::Error::custom("a signal that is there twice"));
                }
                map.next_value_seed(At(column))?;
            } else {
                map.next_value::<IgnoredAny>()?;
            }
        }
        Ok(())
    }
}

/// The name of a signal.
struct Place<'a> {
    table: &'a mut Table,
    nth: usize,
}

impl<'de> DeserializeSeed<'de> for Place<'_> {
    type Value = Option<usize>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_str(self)
    }
}

impl Visitor<'_> for Place<'_> {
    type Value = Option<usize>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the name of a signal")
    }

    fn visit_str<E: Error>(self, name: &str) -> Result<Self::Value, E> {
        Ok(self.table.place(self.nth, name))
    }
}

/// The value of a signal.
struct At<'a>(&'a mut Column);

impl At<'_> {
    fn push<E: Error>(self, cell: Cell<'_>) -> Result<(), E> {
        fitting(self.0.push(cell))
    }
}

fn fitting<E: Error>(pushed: Result<(), Unfit>) -> Result<(), E> {
    pushed.map_err(|Unfit| E::custom("a value of another kind than before"))
}

impl<'de> DeserializeSeed<'de> for At<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for At<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number, a name, yes or no, null, or a row of numbers")
    }

    fn visit_unit<E: Error>(self) -> Result<(), E> {
        self.push(Cell::Null)
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<(), E> {
        self.push(Cell::Flag(value))
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<(), E> {
        self.push(Cell::Count(value))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<(), E> {
        self.push(Cell::Count(i64::try_from(value).map_err(E::custom)?))
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<(), E> {
        self.push(Cell::Number(value))
    }

    fn visit_str<E: Error>(self, name: &str) -> Result<(), E> {
        self.push(Cell::Name(name))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut row: A) -> Result<(), A::Error> {
        let next = || Ok(row.next_element::<Option<f64>>()?.map(|number| number.unwrap_or(f64::NAN)));
        fitting(self.0.push_row(next)?)
    }
}
