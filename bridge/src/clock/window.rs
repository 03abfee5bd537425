//! The least of what was seen in a sliding window of time.

const BLOCKS: usize = 8;

/// A key and what belongs to it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Least<V> {
    pub(crate) key: i64,
    pub(crate) value: V,
}

/// The least key of a window of time, in bounded memory.
///
/// The window is cut into eight blocks of which each keeps its least; so it reaches back between seven and eight
/// eighths of its length.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct WindowMinimum<V> {
    block_ns: u64,
    newest: u64,
    blocks: [Option<Least<V>>; BLOCKS],
    least: Option<Least<V>>,
}

impl<V: Copy> WindowMinimum<V> {
    pub(crate) fn new(window_ns: u64) -> Self {
        Self { block_ns: (window_ns / BLOCKS as u64).max(1), newest: 0, blocks: [None; BLOCKS], least: None }
    }

    /// Adds what was seen at `now_ns`; of equal keys the newest counts.
    pub(crate) fn add(&mut self, now_ns: u64, key: i64, value: V) {
        let block = (now_ns / self.block_ns).max(self.newest);
        if block > self.newest {
            for passed in (self.newest + 1..=block).take(self.blocks.len()) {
                self.blocks[Self::slot(passed)] = None;
            }
            self.newest = block;
            self.least = self.blocks.iter().flatten().min_by_key(|least| least.key).copied();
        }
        let seen = Some(Least { key, value });
        let slot = &mut self.blocks[Self::slot(block)];
        for kept in [slot, &mut self.least] {
            if kept.is_none_or(|kept| key <= kept.key) {
                *kept = seen;
            }
        }
    }

    /// The least of the window that ends at the newest addition.
    pub(crate) fn least(&self) -> Option<Least<V>> {
        self.least
    }

    pub(crate) fn clear(&mut self) {
        self.blocks.fill(None);
        self.least = None;
    }

    fn slot(block: u64) -> usize {
        usize::try_from(block % BLOCKS as u64).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// By brute force: the least of the blocks that the window touches.
        #[test]
        fn is_the_least_of_the_last_eight_blocks(
            steps in prop::collection::vec((0u64..400, -50i64..50), 1..300)
        ) {
            let mut window = WindowMinimum::new(800);
            let mut now = 0;
            let mut all = Vec::new();
            for (step, key) in steps {
                now += step;
                window.add(now, key, now);
                all.push((now / 100, key, now));
                let wanted = all.iter().filter(|(block, ..)| block + 8 > now / 100).map(|&(_, key, _)| key).min();
                prop_assert_eq!(window.least().map(|least| least.key), wanted);
            }
        }
    }

    #[test]
    fn a_silence_of_centuries_costs_no_time_and_forgets_all() {
        let mut window = WindowMinimum::new(8);
        window.add(0, -5, ());
        window.add(u64::MAX, 7, ());
        assert_eq!(window.least().map(|least| least.key), Some(7));
    }
}
