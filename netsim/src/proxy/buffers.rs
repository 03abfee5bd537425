//! Memory for datagrams in flight: fixed cells, reserved once.

/// Largest payload carried, in bytes: above any Ethernet frame. Larger datagrams are counted and dropped.
pub const MAX_DATAGRAM: usize = 2048;

/// A datagram kept in a [`BufferPool`].
#[derive(Debug)]
pub(super) struct Slot {
    cell: usize,
    length: usize,
}

/// `capacity` cells of [`MAX_DATAGRAM`] bytes, each with something that is known of its datagram.
#[derive(Debug)]
pub(super) struct BufferPool<T> {
    /// Zeroed, so the operating system maps a page only when a cell on it is first used.
    bytes: Vec<u8>,
    about: Vec<Option<T>>,
    /// Last in, first out: as few cells are touched as were ever in flight together.
    free: Vec<usize>,
}

impl<T> BufferPool<T> {
    pub(super) fn with_capacity(capacity: usize) -> Self {
        Self {
            bytes: vec![0; capacity * MAX_DATAGRAM],
            about: (0..capacity).map(|_| None).collect(),
            free: (0..capacity).rev().collect(),
        }
    }

    /// Copies a datagram of at most [`MAX_DATAGRAM`] bytes in, if a cell is free; `change` may alter the copy and says
    /// how much of it is kept.
    pub(super) fn store(
        &mut self,
        datagram: &[u8],
        about: T,
        change: impl FnOnce(&mut [u8]) -> usize,
    ) -> Option<Slot> {
        let cell = self.free.pop()?;
        let start = cell * MAX_DATAGRAM;
        let copy = &mut self.bytes[start..start + datagram.len()];
        copy.copy_from_slice(datagram);
        let length = change(copy).min(datagram.len());
        self.about[cell] = Some(about);
        Some(Slot { cell, length })
    }

    /// The datagram in a slot.
    pub(super) fn read(&self, slot: &Slot) -> &[u8] {
        let start = slot.cell * MAX_DATAGRAM;
        &self.bytes[start..start + slot.length]
    }

    /// What is known of the datagram in a slot.
    pub(super) fn about(&self, slot: &Slot) -> Option<&T> {
        self.about[slot.cell].as_ref()
    }

    /// Takes the cell back. A slot is consumed, so none is given back twice.
    pub(super) fn release(&mut self, Slot { cell, .. }: Slot) {
        self.free.push(cell);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_keep_their_datagrams_apart_and_are_reused() {
        let whole = |bytes: &mut [u8]| bytes.len();
        let mut pool = BufferPool::with_capacity(2);
        let a = pool.store(b"first", 'a', whole).unwrap();
        let b = pool.store(&[7; MAX_DATAGRAM], 'b', whole).unwrap();
        assert!(pool.store(b"third", 'c', whole).is_none());
        assert_eq!((pool.read(&a), pool.about(&a)), (&b"first"[..], Some(&'a')));
        assert_eq!(pool.read(&b), [7; MAX_DATAGRAM]);
        pool.release(a);
        let cut = |bytes: &mut [u8]| {
            bytes[0] = b'T';
            3
        };
        let c = pool.store(b"third", 'c', cut).unwrap();
        assert_eq!((pool.read(&c), pool.about(&c)), (&b"Thi"[..], Some(&'c')));
        assert_eq!((pool.read(&b), pool.about(&b)), (&[7; MAX_DATAGRAM][..], Some(&'b')));
    }
}
