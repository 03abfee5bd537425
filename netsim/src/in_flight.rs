//! Packets in flight, ordered by arrival.

use std::cmp::Ordering;
use std::collections::{BinaryHeap, VecDeque};

use crate::verdict::DropCause;

/// Default capacity in packets: a minute at 1 kHz.
pub const DEFAULT_CAPACITY: usize = 65_536;

/// Capacity that a growing queue reserves at first, in packets.
const FIRST_CAPACITY: usize = 256;

/// Bounded queue ordered by (due time, order of entry): packets due together leave in order of entry.
///
/// Most packets are due after all earlier ones and wait in a line; overtaking packets wait in a heap. Except
/// in a growing queue, memory is reserved once; pushing and popping allocate nothing. Payloads move within
/// the heap, so a large payload should be a handle.
#[derive(Clone, Debug)]
pub struct InFlight<T> {
    /// Ordered by due time and by entry alike.
    in_turn: VecDeque<Entry<T>>,
    /// Due before an earlier packet.
    overtaking: BinaryHeap<Entry<T>>,
    /// Due time of the next packet; `u64::MAX` if empty.
    next_ns: u64,
    /// Due time of the last packet in `in_turn`; 0 if none.
    last_in_turn_ns: u64,
    capacity: usize,
    next_order: u64,
    overflowed: u64,
}

impl<T> InFlight<T> {
    /// Create an empty queue for at most `capacity` packets.
    pub fn with_capacity(capacity: usize) -> Self {
        Self::reserving(capacity, capacity)
    }

    /// Create an empty queue for at most `capacity` packets that allocates as they come.
    pub fn growing(capacity: usize) -> Self {
        Self::reserving(capacity, capacity.min(FIRST_CAPACITY))
    }

    fn reserving(capacity: usize, reserved: usize) -> Self {
        Self {
            in_turn: VecDeque::with_capacity(reserved),
            overtaking: BinaryHeap::with_capacity(reserved),
            next_ns: u64::MAX,
            last_in_turn_ns: 0,
            capacity,
            next_order: 0,
            overflowed: 0,
        }
    }

    /// Add a packet due at `due_ns`, or drop it with [`DropCause::InFlight`].
    #[inline(always)] // in the per-packet loop
    pub fn push(&mut self, due_ns: u64, payload: T) -> Result<(), DropCause> {
        if self.len() >= self.capacity {
            self.overflowed += 1;
            return Err(DropCause::InFlight);
        }
        let entry = Entry { due_ns, order: self.next_order, payload };
        self.next_order += 1;
        self.next_ns = self.next_ns.min(due_ns);
        if due_ns >= self.last_in_turn_ns {
            self.last_in_turn_ns = due_ns;
            self.in_turn.push_back(entry);
        } else {
            self.overtaking.push(entry);
        }
        Ok(())
    }

    fn first_overtakes(&self) -> bool {
        match (self.in_turn.front(), self.overtaking.peek()) {
            (Some(in_turn), Some(overtaking)) => overtaking > in_turn,
            (in_turn, _) => in_turn.is_none(),
        }
    }

    /// Due time of the next packet.
    #[inline]
    pub fn next_due(&self) -> Option<u64> {
        (!self.is_empty()).then_some(self.next_ns)
    }

    /// Remove the next packet due by `now_ns`, with its due time.
    #[inline]
    pub fn pop_due(&mut self, now_ns: u64) -> Option<(u64, T)> {
        if now_ns < self.next_ns {
            return None;
        }
        self.pop()
    }

    #[inline(always)] // per packet
    fn pop(&mut self) -> Option<(u64, T)> {
        if !self.overtaking.is_empty() {
            return self.pop_of_both();
        }
        let next = self.in_turn.pop_front()?;
        self.next_ns = self.first_in_turn_ns();
        Some((next.due_ns, next.payload))
    }

    #[inline(never)] // rare: packets overtake on few links
    fn pop_of_both(&mut self) -> Option<(u64, T)> {
        let overtakes = self.first_overtakes();
        let next = if overtakes { self.overtaking.pop() } else { self.in_turn.pop_front() }?;
        let overtaking_ns = self.overtaking.peek().map_or(u64::MAX, |entry| entry.due_ns);
        self.next_ns = self.first_in_turn_ns().min(overtaking_ns);
        Some((next.due_ns, next.payload))
    }

    /// Due time of the first packet in line. An empty line is reset.
    #[inline]
    fn first_in_turn_ns(&mut self) -> u64 {
        if let Some(first) = self.in_turn.front() {
            return first.due_ns;
        }
        self.last_in_turn_ns = 0;
        u64::MAX
    }

    /// Packets in flight.
    pub fn len(&self) -> usize {
        self.in_turn.len() + self.overtaking.len()
    }

    /// Test if the queue is empty.
    pub fn is_empty(&self) -> bool {
        self.in_turn.is_empty() && self.overtaking.is_empty()
    }

    /// Packets dropped because the queue was full.
    pub fn overflowed(&self) -> u64 {
        self.overflowed
    }
}

impl<T> Default for InFlight<T> {
    fn default() -> Self {
        Self::with_capacity(DEFAULT_CAPACITY)
    }
}

#[derive(Clone, Debug)]
struct Entry<T> {
    due_ns: u64,
    order: u64,
    payload: T,
}

impl<T> Ord for Entry<T> {
    /// Reversed, because the heap returns the greatest first.
    fn cmp(&self, other: &Self) -> Ordering {
        (other.due_ns, other.order).cmp(&(self.due_ns, self.order))
    }
}

impl<T> PartialOrd for Entry<T> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<T> PartialEq for Entry<T> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl<T> Eq for Entry<T> {}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Few distinct times, so that most packets share a due time.
        #[test]
        fn packets_leave_by_due_time_and_then_as_they_came(dues in prop::collection::vec(0_u64..20, 0..200)) {
            let mut queue = InFlight::default();
            for (position, &due_ns) in dues.iter().enumerate() {
                queue.push(due_ns, position).unwrap();
            }
            let mut expected: Vec<(u64, usize)> = dues.iter().copied().zip(0..).collect();
            expected.sort_by_key(|&(due_ns, _)| due_ns);

            let mut left = Vec::new();
            for now_ns in 0..20 {
                while let Some((due_ns, position)) = queue.pop_due(now_ns) {
                    prop_assert_eq!(due_ns, now_ns);
                    left.push((due_ns, position));
                }
            }
            prop_assert_eq!(left, expected);
            prop_assert!(queue.is_empty());
        }
    }

    proptest! {
        /// Compare random pushes and pops with a sorted list, including overtaking and maximal times.
        #[test]
        fn queue_matches_a_sorted_list(
            acts in prop::collection::vec(
                (any::<bool>(), prop_oneof![0_u64..12, Just(u64::MAX)], prop_oneof![0_u64..12, Just(u64::MAX)]), 0..200
            ),
        ) {
            let mut queue = InFlight::default();
            let mut sorted: Vec<(u64, usize)> = Vec::new();
            for (order, (is_push, due_ns, now_ns)) in acts.into_iter().enumerate() {
                if is_push {
                    queue.push(due_ns, order).unwrap();
                    sorted.insert(sorted.partition_point(|&(other_ns, _)| other_ns <= due_ns), (due_ns, order));
                } else {
                    let due = sorted.first().is_some_and(|&(due_ns, _)| due_ns <= now_ns);
                    prop_assert_eq!(queue.pop_due(now_ns), due.then(|| sorted.remove(0)));
                }
                prop_assert_eq!(queue.next_due(), sorted.first().map(|&(due_ns, _)| due_ns));
                prop_assert_eq!(queue.len(), sorted.len());
            }
        }
    }

    #[test]
    fn nothing_leaves_before_it_is_due() {
        let mut queue = InFlight::default();
        queue.push(10, 'a').unwrap();
        assert_eq!(queue.next_due(), Some(10));
        assert_eq!(queue.pop_due(9), None);
        assert_eq!(queue.pop_due(10), Some((10, 'a')));
        assert_eq!(queue.pop_due(u64::MAX), None);
    }

    #[test]
    fn a_full_queue_drops_the_newest_and_counts_it() {
        let mut queue = InFlight::with_capacity(2);
        queue.push(1, 'a').unwrap();
        queue.push(2, 'b').unwrap();
        assert_eq!(queue.push(0, 'c'), Err(DropCause::InFlight));
        assert_eq!((queue.len(), queue.overflowed()), (2, 1));
        assert_eq!(queue.pop_due(5), Some((1, 'a')));
        queue.push(3, 'd').unwrap();
    }

    #[test]
    fn growing_queue_reaches_its_capacity() {
        let most = DEFAULT_CAPACITY + 10;
        let mut queue = InFlight::growing(most);
        for position in 0..most {
            queue.push(1, position).unwrap();
        }
        assert_eq!(queue.push(1, most), Err(DropCause::InFlight));
        assert_eq!((queue.len(), queue.pop_due(1)), (most, Some((1, 0))));
    }
}
