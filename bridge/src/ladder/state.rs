//! Where an endpoint stands.

/// Where an endpoint stands, from the least to the most that has gone wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum LadderState {
    /// Not coupled: the master moves freely and the slave holds. Before the first press, while the clutch is open, and
    /// after a press that was not answered in time.
    Disengaged,
    /// The clutch is pressed; waits until the other side says the same, but no longer than `LadderSettings::align_ns`.
    Aligning,
    /// Coupled.
    Engaged,
    /// Coupled, but the peer's frames are late: the slave goes on with a velocity that decays to zero.
    Stale,
    /// The peer is silent: the slave holds, the master's force fades to zero. Left by a new press of the clutch only.
    Hold,
    /// Silent for too long. Latched: left by a new press of the clutch, or at a slave by a master that was started anew.
    Stop,
    /// A number that cannot be. Latched: left by a local act at this side only.
    Fault,
}

impl LadderState {
    /// All states in the order of their codes.
    pub const ALL: [Self; 7] =
        [Self::Disengaged, Self::Aligning, Self::Engaged, Self::Stale, Self::Hold, Self::Stop, Self::Fault];

    /// The state's byte on the wire and in records.
    pub const fn code(self) -> u8 {
        self as u8
    }

    /// The state's name in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Disengaged => "disengaged",
            Self::Aligning => "aligning",
            Self::Engaged => "engaged",
            Self::Stale => "stale",
            Self::Hold => "hold",
            Self::Stop => "stop",
            Self::Fault => "fault",
        }
    }

    /// The state with that byte.
    pub fn from_code(code: u8) -> Option<Self> {
        Self::ALL.get(usize::from(code)).copied()
    }

    /// Whether the slave follows and the master renders.
    pub const fn is_coupled(self) -> bool {
        matches!(self, Self::Engaged | Self::Stale)
    }

    /// Whether the clutch's press was taken up: coupled, or about to be.
    pub const fn is_aligned(self) -> bool {
        matches!(self, Self::Aligning | Self::Engaged | Self::Stale)
    }

    /// Whether something is wrong, so that nothing but a deliberate act couples again.
    pub const fn is_held(self) -> bool {
        matches!(self, Self::Hold | Self::Stop | Self::Fault)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_reversible() {
        for (code, state) in (0_u8..).zip(LadderState::ALL) {
            assert_eq!((state.code(), LadderState::from_code(code)), (code, Some(state)));
        }
        assert_eq!(LadderState::from_code(7), None);
    }
}
