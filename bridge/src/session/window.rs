//! Which counters have been there: the window against replay, and the order of what arrives.

/// Where a counter stands among those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// Above all before it.
    Newer,
    /// Below the newest, and not seen before.
    Late,
    /// Seen before.
    Duplicate,
    /// Too far below the newest to tell whether it was seen before.
    TooOld,
}

/// A bitmap of the newest `reach` counters. It is not shifted, and its memory is reserved once.
///
/// Words form a ring; passing to a newer counter clears the words between. One word more than the reach asks for, so
/// that the oldest counters within reach never share their word with the newest.
///
/// Source: RFC 6479; RFC 4303, section 3.4.3 (judged before the tag is checked, marked after).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReplayWindow {
    words: Box<[u64]>,
    reach: u64,
    newest: Option<u64>,
}

impl ReplayWindow {
    /// A window over the newest `reach` counters, at least one.
    pub fn new(reach: u32) -> Self {
        let reach = reach.max(1);
        let words = (reach.div_ceil(64) as usize + 1).next_power_of_two();
        Self { words: vec![0; words].into_boxed_slice(), reach: u64::from(reach), newest: None }
    }

    /// Word and bit of a counter.
    fn place(&self, counter: u64) -> (usize, u64) {
        #[allow(clippy::cast_possible_truncation)] // masked to the length of a slice, a power of two
        let word = ((counter / 64) & (self.words.len() as u64 - 1)) as usize;
        (word, 1 << (counter % 64))
    }

    /// Says where a counter stands, and changes nothing.
    pub fn judge(&self, counter: u64) -> Arrival {
        match self.newest {
            Some(newest) if counter <= newest => {
                if newest - counter >= self.reach {
                    return Arrival::TooOld;
                }
                let (word, bit) = self.place(counter);
                if self.words[word] & bit == 0 { Arrival::Late } else { Arrival::Duplicate }
            }
            _ => Arrival::Newer,
        }
    }

    /// Marks a counter as seen and says where it stood before; one that is too old is not marked.
    pub fn mark(&mut self, counter: u64) -> Arrival {
        let arrival = self.judge(counter);
        if arrival == Arrival::Newer {
            if let Some(newest) = self.newest {
                let passed = (counter / 64 - newest / 64).min(self.words.len() as u64);
                for step in 0..passed {
                    let (word, _) = self.place(counter - 64 * step);
                    self.words[word] = 0;
                }
            }
            self.newest = Some(counter);
        }
        if arrival != Arrival::TooOld {
            let (word, bit) = self.place(counter);
            self.words[word] |= bit;
        }
        arrival
    }

    /// Forgets all counters.
    pub fn clear(&mut self) {
        self.words.fill(0);
        self.newest = None;
    }

    /// The highest counter marked.
    pub fn newest(&self) -> Option<u64> {
        self.newest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    /// The same by the definition, with a set of all that was there.
    fn judged(seen: &BTreeSet<u64>, reach: u64, counter: u64) -> Arrival {
        match seen.last() {
            Some(newest) if counter <= *newest => {
                if newest - counter >= reach {
                    Arrival::TooOld
                } else if seen.contains(&counter) {
                    Arrival::Duplicate
                } else {
                    Arrival::Late
                }
            }
            _ => Arrival::Newer,
        }
    }

    #[test]
    fn the_ends_of_the_numbers_hold() {
        let mut window = ReplayWindow::new(64);
        assert_eq!(window.mark(u64::MAX - 1), Arrival::Newer);
        assert_eq!(window.mark(u64::MAX), Arrival::Newer);
        assert_eq!(window.mark(u64::MAX - 63), Arrival::Late);
        assert_eq!(window.mark(u64::MAX - 64), Arrival::TooOld);
        assert_eq!(window.mark(0), Arrival::TooOld);
        window.clear();
        assert_eq!(window.mark(0), Arrival::Newer);
        assert_eq!(window.mark(0), Arrival::Duplicate);
    }

    proptest! {
        #[test]
        fn it_agrees_with_a_set(
            reach in 1u32..400,
            start in prop_oneof![Just(0u64), Just(u64::MAX - 100_000), any::<u64>().prop_map(|n| n / 2)],
            steps in prop::collection::vec(prop_oneof![8 => -500i64..100, 1 => 0i64..2000], 1..400),
        ) {
            let (mut window, mut seen, mut at) = (ReplayWindow::new(reach), BTreeSet::new(), start);
            for step in steps {
                let counter = at.saturating_add_signed(step);
                let expected = judged(&seen, u64::from(reach), counter);
                prop_assert_eq!(window.judge(counter), expected);
                prop_assert_eq!(window.mark(counter), expected);
                seen.insert(counter);
                at = *seen.last().unwrap();
                prop_assert_eq!(window.newest(), Some(at));
            }
        }
    }
}
