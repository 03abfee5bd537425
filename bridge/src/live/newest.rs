//! The newest records of a live loop.

use std::mem::MaybeUninit;

/// Ring of the newest records of a loop, allocated at the start.
#[derive(Debug)]
pub struct Newest<R> {
    records: Vec<R>,
    /// Index of the oldest record, once full.
    oldest: usize,
    room: usize,
}

impl<R> Newest<R> {
    /// Allocates and touches room for `room` records; `None` without memory.
    pub fn of(room: usize) -> Option<Self> {
        let mut records = Vec::new();
        records.try_reserve_exact(room).ok()?;
        records.spare_capacity_mut().fill_with(MaybeUninit::zeroed);
        Some(Self { records, oldest: 0, room })
    }

    pub(super) fn room(&self) -> usize {
        self.room
    }

    /// Add a record. Returns whether no older record was overwritten.
    pub(super) fn push(&mut self, record: R) -> bool {
        if self.records.len() < self.room {
            self.records.push(record);
            return true;
        }
        if let Some(oldest) = self.records.get_mut(self.oldest) {
            *oldest = record;
            self.oldest = (self.oldest + 1) % self.room;
        }
        // A ring without room loses nothing.
        self.room == 0
    }

    pub(super) fn into_records(self) -> Vec<R> {
        let Self { mut records, oldest, .. } = self;
        records.rotate_left(oldest);
        records
    }
}

impl<R> Default for Newest<R> {
    /// No room.
    fn default() -> Self {
        Self { records: Vec::new(), oldest: 0, room: 0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn newest_records_keep_their_order() {
        for (room, pushed, expected) in
            [(0, 3, 0..0), (3, 0, 0..0), (3, 2, 0..2), (3, 3, 0..3), (3, 4, 1..4), (3, 8, 5..8)]
        {
            let mut newest = Newest::of(room).unwrap();
            let fitted = (0..pushed).filter(|number| newest.push(*number)).count();
            assert_eq!(fitted, if room == 0 { pushed } else { pushed.min(room) }, "{room} {pushed}");
            assert_eq!(newest.into_records(), expected.collect::<Vec<_>>(), "{room} {pushed}");
        }
    }
}
