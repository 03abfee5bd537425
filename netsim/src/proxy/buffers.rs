//! Memory for datagrams in flight: fixed cells, reserved once.

/// Largest payload carried, in bytes: above any Ethernet frame. Larger datagrams are counted and dropped.
pub const MAX_DATAGRAM: usize = 2048;

/// A datagram kept in a [`BufferPool`].
#[derive(Debug)]
pub(super) struct Slot {
    cell: usize,
    length: usize,
}

/// `capacity` cells of [`MAX_DATAGRAM`] bytes.
#[derive(Debug)]
pub(super) struct BufferPool {
    /// Zeroed, so the operating system maps a page only when a cell on it is first used.
    bytes: Vec<u8>,
    /// Last in, first out: as few cells are touched as were ever in flight together.
    free: Vec<usize>,
}

impl BufferPool {
    pub(super) fn with_capacity(capacity: usize) -> Self {
        Self { bytes: vec![0; capacity * MAX_DATAGRAM], free: (0..capacity).rev().collect() }
    }

    /// Copies a datagram of at most [`MAX_DATAGRAM`] bytes in, if a cell is free.
    pub(super) fn store(&mut self, datagram: &[u8]) -> Option<Slot> {
        let cell = self.free.pop()?;
        let length = datagram.len();
        let start = cell * MAX_DATAGRAM;
        self.bytes[start..start + length].copy_from_slice(datagram);
        Some(Slot { cell, length })
    }

    /// The datagram in a slot.
    pub(super) fn read(&self, slot: &Slot) -> &[u8] {
        let start = slot.cell * MAX_DATAGRAM;
        &self.bytes[start..start + slot.length]
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
        let mut pool = BufferPool::with_capacity(2);
        let a = pool.store(b"first").unwrap();
        let b = pool.store(&[7; MAX_DATAGRAM]).unwrap();
        assert!(pool.store(b"third").is_none());
        assert_eq!(pool.read(&a), b"first");
        assert_eq!(pool.read(&b), [7; MAX_DATAGRAM]);
        pool.release(a);
        let c = pool.store(b"third").unwrap();
        assert_eq!(pool.read(&c), b"third");
        assert_eq!(pool.read(&b), [7; MAX_DATAGRAM]);
    }
}
