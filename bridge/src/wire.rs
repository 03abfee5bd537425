//! The frame that master and slave exchange, byte for byte.
//!
//! All numbers are little-endian. A frame of N axes has `HEADER + 24 N + 36` bytes, 80 more of kind `pose`, 24 more with
//! a gripper and 4 more with buttons, the same for every frame of a session:
//!
//! | offset | type | field |
//! |---|---|---|
//! | 0 | `[u8; 2]` | magic, `HT` |
//! | 2 | `u8` | version, 5 |
//! | 3 | `u8` | role of the sender: 1 master, 2 slave |
//! | 4 | `u8` | axes N, and 16 times the kind: 1 linear, 2 joints, 3 pose |
//! | 5 | `u8` | state of the sender's ladder |
//! | 6 | `u16` | flags: bit 0, the echo is valid; bit 1, the sender hears the peer; bit 2, its clutch is closed; bit 3, it ends; bit 4, the state of its gripper or trigger is known; bit 5, its gripper holds something |
//! | 8 | `u64` | run id: drawn by the sender when it starts |
//! | 16 | `u64` | sequence, from 0, one more with each frame |
//! | 24 | `u64` | echo: newest sequence received from the peer |
//! | 32 | `u64` | time of sending, sender's monotonic clock in ns |
//! | 40 | `u64` | echo: time of sending of that frame, the peer's clock in ns |
//! | 48 | `u64` | echo: time in ns since that frame arrived |
//! | 56 | `u64` | echo: run id of that frame |
//! | 64 | `[f64; N]` | position in m (rad) |
//! | 64 + 8 N | `[f64; N]` | velocity in m/s (rad/s) |
//! | 64 + 16 N | `[f64; N]` | force in N (N m): master, `F_device`; slave, force of the environment |
//! | 64 + 24 N | `[f64; 4]` | only of kind `pose`, and what follows 80 bytes later: orientation, unit quaternion w, x, y, z |
//! | 96 + 24 N | `[f64; 3]` | angular velocity in rad/s |
//! | 120 + 24 N | `[f64; 3]` | torque in N m: master, of the device; slave, of the environment |
//! | 64 + 24 N | `f64` | energy in J that this side's plant has put into the link since its start; it never falls |
//! | 72 + 24 N | `f64` | energy in J that this side's plant has had out of the link; it never falls |
//! | 80 + 24 N | `[f64; 3]` | only with a gripper, and what follows 24 bytes later: position of gripper or trigger, 0 open to 1 closed; velocity in 1/s; force in N |
//! | 80 + 24 N | `u32` | only with buttons, and what follows 4 bytes later: bit n, button n of the master is pressed; 0 of a slave |
//! | 80 + 24 N | `u8` | why the sender stands in its state, [`crate::Reason::code`]; 0 where it began |
//! | 81 + 24 N | `u8` | its fault, [`haptether_safety::Fault::code`]; 0 without |
//! | 82 + 24 N | `u8` | number of its fault's text, 1 to 255; 0 without |
//! | 83 + 24 N | `u8` | which piece of that text follows, 0 to 19 |
//! | 84 + 24 N | `[u8; 12]` | that piece, UTF-8; zeros after the end of the text |
//! | 96 + 24 N | `u32` | CRC-32 (IEEE) of all bytes before |
//!
//! A frame has one encoding: flags without a meaning are zero, and so are the fields of an echo that is not valid,
//! those of a gripper that is not known, those of a text that there is not, and what lies after the end of a text; of q
//! and -q the quaternion is the one of [`crate::coupling::canonical`], of norm 1 to 1e-9. Codes of reasons and faults
//! steer nothing: one that this version does not know is passed on and shown as a number.
//!
//! Which parts there are is agreed on beforehand, by the scene: [`FrameLayout`]. A frame of another layout is refused.
//!
//! Positions are absolute, never increments: a lost frame costs what it says and nothing else.

use haptether_safety::{Axes, Signal};
use zerocopy::{
    FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned,
    little_endian::{U16, U64},
};

use crate::{
    SideKind,
    coupling::{GripperState, MAX_ENERGY_J, PortEnergy, RotationState, canonical, checked, is_canonical},
    fault_text::{PIECE, TextPiece},
};

/// Magic bytes at the start of a frame.
pub const MAGIC: [u8; 2] = *b"HT";
/// Version of the frame.
pub const VERSION: u8 = 5;
/// Bytes before the first axis.
pub const HEADER: usize = 64;
/// Bytes of the two energies.
const ENERGIES: usize = 16;
/// Numbers of the rotation of a pose: quaternion, angular velocity, torque.
const ROTATION: usize = 10;
/// Bytes of the state of a gripper.
const GRIPPER: usize = 24;
/// Bytes of the buttons.
const BUTTONS: usize = 4;
/// Bytes of what a sender says of its cause.
const CAUSE: usize = 4 + PIECE;
/// Bytes of the checksum.
const CHECKSUM: usize = 4;
/// Max. number of axes of a device or an arm.
pub const MAX_AXES: usize = 7;
/// Bytes of the longest frame: seven joints are longer than three axes with an orientation.
pub const MAX_FRAME: usize =
    FrameLayout { kind: SideKind::Joints, has_gripper: true, has_buttons: true }.length(MAX_AXES);

/// What stands in every frame of a session besides axes and energies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameLayout {
    /// What the coordinates are; a rotation stands in those of a pose.
    pub kind: SideKind,
    /// Gripper and trigger.
    pub has_gripper: bool,
    /// The buttons of the master.
    pub has_buttons: bool,
}

impl FrameLayout {
    /// Bytes of a frame of `axes` axes.
    pub const fn length(self, axes: usize) -> usize {
        let rotation = if matches!(self.kind, SideKind::Pose) { 8 * ROTATION } else { 0 };
        let gripper = if self.has_gripper { GRIPPER } else { 0 };
        let buttons = if self.has_buttons { BUTTONS } else { 0 };
        HEADER + 24 * axes + rotation + ENERGIES + gripper + buttons + CAUSE + CHECKSUM
    }

    /// What both sides say of their frames in the handshake.
    #[allow(clippy::cast_possible_truncation)] // at most 7 axes
    pub const fn form(self, axes: usize) -> FrameForm {
        let parts = (self.has_gripper as u16) << 6 | (self.has_buttons as u16) << 7;
        FrameForm((VERSION as u16) << 12 | parts | (self.kind.code() as u16) << 3 | axes as u16)
    }
}

/// What a side says of its frames in the handshake: bits 0 to 2 their axes, 3 to 5 their kind, 6 whether they have a
/// gripper, 7 buttons, 12 to 15 their version.
///
/// Before version 5 it was their length in bytes, so that a side of such a version is known by the version 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameForm(pub u16);

impl std::fmt::Display for FrameForm {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self(form) = self;
        let version = form >> 12;
        if version != u16::from(VERSION) {
            let before = if version == 0 { "4 or before".to_owned() } else { version.to_string() };
            return write!(
                f,
                "of version {before}, must be of {VERSION}: install the same Haptether on both sides"
            );
        }
        let kinds = [SideKind::Linear, SideKind::Joints, SideKind::Pose];
        let kind = kinds.into_iter().find(|kind| u16::from(kind.code()) == form >> 3 & 7);
        let with = |bit: u16, what: &'static str| if form >> bit & 1 == 1 { what } else { "" };
        let (gripper, buttons) = (with(6, ", with a gripper"), with(7, ", with buttons"));
        write!(
            f,
            "of kind {} and {} axes{gripper}{buttons}",
            kind.map_or("unknown", SideKind::name),
            form & 7
        )
    }
}

/// Who sent a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The side of the hand.
    Master,
    /// The side of the robot.
    Slave,
}

impl Role {
    /// Its name: "master" or "slave".
    pub const fn name(self) -> &'static str {
        match self {
            Self::Master => "master",
            Self::Slave => "slave",
        }
    }

    /// The other one.
    #[must_use]
    pub const fn peer(self) -> Self {
        match self {
            Self::Master => Self::Slave,
            Self::Slave => Self::Master,
        }
    }

    pub(crate) const fn byte(self) -> u8 {
        match self {
            Self::Master => 1,
            Self::Slave => 2,
        }
    }
}

/// The newest frame of the peer, returned to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Echo {
    /// Its run: an echo of another one was meant for somebody else.
    pub run_id: u64,
    /// Its sequence.
    pub sequence: u64,
    /// Its time of sending, on the peer's clock in ns.
    pub sent_ns: u64,
    /// How long ago it arrived, in ns.
    pub held_ns: u64,
}

/// A frame, decoded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame<const N: usize> {
    /// Who sent it.
    pub role: Role,
    /// What its coordinates are.
    pub kind: SideKind,
    /// State of the sender's ladder, [`crate::LadderState::code`].
    pub state: u8,
    /// Whether the sender has heard the peer recently enough to stay engaged.
    pub hears_peer: bool,
    /// Whether the clutch is closed: the master's button; a slave has none.
    pub clutch: bool,
    /// Drawn by the sender when it started.
    pub run_id: u64,
    /// From 0, one more with each frame.
    pub sequence: u64,
    /// Time of sending in ns, sender's monotonic clock.
    pub sent_ns: u64,
    /// What the sender last received.
    pub echo: Option<Echo>,
    /// Position in m.
    pub position: Axes<N>,
    /// Velocity in m/s.
    pub velocity: Axes<N>,
    /// Force in N.
    pub force: Axes<N>,
    /// Orientation, angular velocity and torque; none but of kind `pose`.
    pub rotation: Option<RotationState>,
    /// What went in and out of the link at the sender's port.
    pub energy: PortEnergy,
    /// Gripper or trigger; none in a session without a gripper.
    pub gripper: Option<GripperState>,
    /// Bit n: button n of the master is pressed; none in a session without buttons.
    pub buttons: Option<u32>,
    /// Whether this is one of the sender's last frames: it ends, in good order.
    pub ending: bool,
    /// Why the sender stands in its state, [`crate::Reason::code`]; 0 where it began.
    pub reason: u8,
    /// Its fault, [`haptether_safety::Fault::code`]; 0 without.
    pub fault: u8,
    /// What this frame carries of the text on the sender's fault.
    pub text: TextPiece,
}

/// Why a datagram is no frame. It changes no state and is only counted.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum WireError {
    /// Of another length.
    #[error("frame of {seen} bytes: must have {allowed}")]
    Length {
        /// Bytes received.
        seen: usize,
        /// Bytes of a frame of this session.
        allowed: usize,
    },
    /// Of something else.
    #[error("magic {0:?}: must be {MAGIC:?}")]
    Magic([u8; 2]),
    /// Of another version.
    #[error("frame version {0}: must be {VERSION}")]
    Version(u8),
    /// From the wrong side.
    #[error("sender role {0}: must be the peer's")]
    Role(u8),
    /// With another number of axes.
    #[error("frame of {seen} axes: must have {allowed}")]
    Axes {
        /// Axes of the frame.
        seen: u8,
        /// Axes of this endpoint.
        allowed: usize,
    },
    /// Of another kind.
    #[error("frame of kind {seen}: must be {}, {}", .allowed.code(), .allowed.name())]
    Kind {
        /// Of the frame: 1 linear, 2 joints, 3 pose.
        seen: u8,
        /// Of this endpoint.
        allowed: SideKind,
    },
    /// With flags that have no meaning, or with an echo that its flag denies.
    #[error(
        "flags {0:#06x}: must be a sum of 1, 2, 4, 8 and with a gripper 16 and 32, and without 1 the fields of the echo zero"
    )]
    Flags(u16),
    /// Damaged in transit.
    #[error("checksum {seen:#010x}: must be {computed:#010x}")]
    Checksum {
        /// As received.
        seen: u32,
        /// Of the bytes received.
        computed: u32,
    },
    /// A number is not finite or absurd.
    #[error("frame {0}: {1}")]
    Value(u64, haptether_safety::Fault),
    /// A quaternion that is no orientation, or not in the one encoding.
    #[error(
        "frame {sequence}: orientation {quat_wxyz:?}: must have a norm of 1 to 1e-9, and its first part that is not 0 above 0"
    )]
    Orientation {
        /// Of the frame.
        sequence: u64,
        /// As received.
        quat_wxyz: [f64; 4],
    },
    /// Buttons of a slave.
    #[error("frame {sequence}: buttons {buttons:#x} of a slave: must be 0")]
    Buttons {
        /// Of the frame.
        sequence: u64,
        /// As received.
        buttons: u32,
    },
    /// Energies that cannot be.
    #[error("frame {sequence}: energies {energy:?}: must be between 0 and {MAX_ENERGY_J} J")]
    Energy {
        /// Of the frame.
        sequence: u64,
        /// As received.
        energy: PortEnergy,
    },
    /// A gripper that cannot be.
    #[error(
        "frame {sequence}: gripper {state:?}: must be at 0 to 1, within 100 1/s and 0 to 10000 N, or all unknown"
    )]
    Gripper {
        /// Of the frame.
        sequence: u64,
        /// As received.
        state: GripperState,
    },
    /// A piece of a text with more than one encoding.
    #[error(
        "frame {sequence}: piece {index} of text {number}: must be 0 to 19 of 1 to 255 with zeros behind its end, or all zeros"
    )]
    Text {
        /// Of the frame.
        sequence: u64,
        /// Of the text.
        number: u8,
        /// Of the piece.
        index: u8,
    },
}

#[derive(Clone, Copy, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned)]
#[repr(C)]
struct Header {
    magic: [u8; 2],
    version: u8,
    role: u8,
    axes: u8,
    state: u8,
    flags: U16,
    run_id: U64,
    sequence: U64,
    echo_sequence: U64,
    sent_ns: U64,
    echo_sent_ns: U64,
    echo_held_ns: U64,
    echo_run_id: U64,
}

impl Header {
    /// Refuses what is no frame of this side's peer.
    fn check(&self, from: Role, kind: SideKind, axes: usize) -> Result<(), WireError> {
        if self.magic != MAGIC {
            return Err(WireError::Magic(self.magic));
        }
        if self.version != VERSION {
            return Err(WireError::Version(self.version));
        }
        if self.role != from.byte() {
            return Err(WireError::Role(self.role));
        }
        if usize::from(self.axes & 0x0F) != axes {
            return Err(WireError::Axes { seen: self.axes & 0x0F, allowed: axes });
        }
        if self.axes >> 4 != kind.code() {
            return Err(WireError::Kind { seen: self.axes >> 4, allowed: kind });
        }
        Ok(())
    }
}

const ECHO_VALID: u16 = 1;
const HEARS_PEER: u16 = 2;
const CLUTCH: u16 = 4;
const ENDING: u16 = 8;
const GRIPPER_KNOWN: u16 = 16;
const HOLDS_OBJECT: u16 = 32;

/// Whether the sender of a frame says that it hears its peer; of bytes that were decoded.
pub(crate) fn hears_peer(frame: &[u8]) -> bool {
    frame.get(6).is_some_and(|flags| u16::from(*flags) & HEARS_PEER != 0)
}

/// What stands in a frame without an echo.
const NO_ECHO: Echo = Echo { run_id: 0, sequence: 0, sent_ns: 0, held_ns: 0 };

impl<const N: usize> Frame<N> {
    /// What stands in it.
    pub const fn layout(&self) -> FrameLayout {
        let Self { kind, gripper, buttons, .. } = self;
        FrameLayout { kind: *kind, has_gripper: gripper.is_some(), has_buttons: buttons.is_some() }
    }

    /// Writes the frame and returns the bytes written.
    pub fn encode<'a>(&self, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        let echo = self.echo.unwrap_or(NO_ECHO);
        let length = self.layout().length(N);
        let gripper = self.gripper.unwrap_or_default();
        #[allow(clippy::cast_possible_truncation)] // at most 7 axes
        let header = Header {
            magic: MAGIC,
            version: VERSION,
            role: self.role.byte(),
            axes: N as u8 | self.kind.code() << 4,
            state: self.state,
            flags: U16::new(
                if self.echo.is_some() { ECHO_VALID } else { 0 }
                    | if self.hears_peer { HEARS_PEER } else { 0 }
                    | if self.clutch { CLUTCH } else { 0 }
                    | if self.ending { ENDING } else { 0 }
                    | if gripper.position.is_some() { GRIPPER_KNOWN } else { 0 }
                    | if gripper.holds_object { HOLDS_OBJECT } else { 0 },
            ),
            run_id: U64::new(self.run_id),
            sequence: U64::new(self.sequence),
            echo_sequence: U64::new(echo.sequence),
            sent_ns: U64::new(self.sent_ns),
            echo_sent_ns: U64::new(echo.sent_ns),
            echo_held_ns: U64::new(echo.held_ns),
            echo_run_id: U64::new(echo.run_id),
        };
        buffer[..HEADER].copy_from_slice(header.as_bytes());
        let energies = [self.energy.in_j, self.energy.out_j];
        let jaws = [gripper.position.unwrap_or(0.0), gripper.velocity, gripper.force_n];
        let jaws = if self.gripper.is_some() { &jaws[..] } else { &[] };
        let mut slots = buffer[HEADER..].chunks_exact_mut(8);
        let mut put = |values: &[f64]| {
            for (value, slot) in values.iter().zip(&mut slots) {
                slot.copy_from_slice(&value.to_le_bytes());
            }
        };
        for part in [&self.position, &self.velocity, &self.force] {
            put(part.as_slice());
        }
        if self.kind == SideKind::Pose {
            let RotationState { orientation, angular_velocity, torque } = self.rotation.unwrap_or_default();
            put(&canonical(&orientation));
            put(angular_velocity.as_slice());
            put(torque.as_slice());
        }
        put(&energies);
        put(jaws);
        let end = length - CHECKSUM;
        let TextPiece { number, index, bytes } = self.text;
        let cause = &mut buffer[end - CAUSE..end];
        cause[..4].copy_from_slice(&[self.reason, self.fault, number, index]);
        cause[4..].copy_from_slice(&bytes);
        if let Some(buttons) = self.buttons {
            buffer[end - CAUSE - BUTTONS..end - CAUSE].copy_from_slice(&buttons.to_le_bytes());
        }
        let checksum = crc32fast::hash(&buffer[..end]);
        buffer[end..length].copy_from_slice(&checksum.to_le_bytes());
        &buffer[..length]
    }

    /// Reads a frame from the peer of role `from`; the cheap refusals first.
    pub fn decode(bytes: &[u8], from: Role, layout: FrameLayout) -> Result<Self, WireError> {
        let FrameLayout { kind, has_gripper, has_buttons } = layout;
        let length = || WireError::Length { seen: bytes.len(), allowed: layout.length(N) };
        if bytes.len() != layout.length(N) {
            return Err(length());
        }
        let (header, _) = Header::read_from_prefix(bytes).map_err(|_| length())?;
        header.check(from, kind, N)?;
        let (body, tail) = bytes.split_at(bytes.len() - CHECKSUM);
        let computed = crc32fast::hash(body);
        let seen = tail.iter().rev().fold(0, |sum, byte| sum << 8 | u32::from(*byte));
        if seen != computed {
            return Err(WireError::Checksum { seen, computed });
        }
        let (sequence, flags) = (header.sequence.get(), header.flags.get());
        let echo = Echo {
            run_id: header.echo_run_id.get(),
            sequence: header.echo_sequence.get(),
            sent_ns: header.echo_sent_ns.get(),
            held_ns: header.echo_held_ns.get(),
        };
        let is_valid = flags & ECHO_VALID != 0;
        let of_gripper = if has_gripper { GRIPPER_KNOWN | HOLDS_OBJECT } else { 0 };
        if flags & !(ECHO_VALID | HEARS_PEER | CLUTCH | ENDING | of_gripper) != 0
            || !(is_valid || echo == NO_ECHO)
        {
            return Err(WireError::Flags(flags));
        }
        let (numbers, cause) = body.split_at(body.len() - CAUSE);
        let numbers = |first: usize| {
            numbers[HEADER + 8 * first..].chunks_exact(8).map(|bytes| {
                let mut value = [0; 8];
                value.copy_from_slice(bytes);
                f64::from_le_bytes(value)
            })
        };
        let axes = |index: usize, signal: Signal| checked_axes(sequence, signal, numbers(N * index));
        let is_pose = kind == SideKind::Pose;
        let mut rest = numbers(3 * N + if is_pose { ROTATION } else { 0 });
        let energy =
            PortEnergy { in_j: rest.next().unwrap_or(f64::NAN), out_j: rest.next().unwrap_or(f64::NAN) };
        if !energy.is_possible() {
            return Err(WireError::Energy { sequence, energy });
        }
        let gripper = has_gripper.then(|| std::array::from_fn(|_| rest.next().unwrap_or(f64::NAN)));
        let gripper = gripper.map(|numbers| decoded_gripper(sequence, flags, numbers)).transpose()?;
        let rotation = is_pose.then(|| decoded_rotation(sequence, from, numbers(3 * N))).transpose()?;
        let word = body[..body.len() - CAUSE].last_chunk().map_or(0, |bytes| u32::from_le_bytes(*bytes));
        let buttons = has_buttons.then_some(word);
        if let (Role::Slave, Some(buttons @ 1..)) = (from, buttons) {
            return Err(WireError::Buttons { sequence, buttons });
        }
        let mut text = TextPiece { number: cause[2], index: cause[3], bytes: [0; PIECE] };
        text.bytes.copy_from_slice(&cause[4..]);
        if !text.is_canonical() {
            return Err(WireError::Text { sequence, number: text.number, index: text.index });
        }
        Ok(Self {
            role: from,
            kind,
            state: header.state,
            hears_peer: flags & HEARS_PEER != 0,
            clutch: flags & CLUTCH != 0,
            run_id: header.run_id.get(),
            sequence,
            sent_ns: header.sent_ns.get(),
            echo: is_valid.then_some(echo),
            position: axes(0, Signal::Position)?,
            velocity: axes(1, Signal::Velocity)?,
            force: axes(
                2,
                match from {
                    Role::Master => Signal::RenderedForce,
                    Role::Slave => Signal::EnvironmentForce,
                },
            )?,
            rotation,
            energy,
            gripper,
            buttons,
            ending: flags & ENDING != 0,
            reason: cause[0],
            fault: cause[1],
            text,
        })
    }
}

/// A gripper or a trigger, or what stands for one that is not known.
fn decoded_gripper(sequence: u64, flags: u16, numbers: [f64; 3]) -> Result<GripperState, WireError> {
    // Zero in no other way than one, so that there is one encoding.
    let is_unknown = numbers.iter().all(|value| value.to_bits() == 0);
    let is_known = flags & GRIPPER_KNOWN != 0;
    let [position, velocity, force_n] = numbers;
    let position = (is_known || !is_unknown).then_some(position);
    let state = GripperState { position, velocity, force_n, holds_object: flags & HOLDS_OBJECT != 0 };
    if state.is_possible() && state.position.is_some() == is_known {
        Ok(state)
    } else {
        Err(WireError::Gripper { sequence, state })
    }
}

/// Quaternion, angular velocity and torque.
fn decoded_rotation(
    sequence: u64,
    from: Role,
    mut numbers: impl Iterator<Item = f64>,
) -> Result<RotationState, WireError> {
    let quat_wxyz = std::array::from_fn(|_| numbers.next().unwrap_or(f64::NAN));
    let orientation = checked(quat_wxyz).ok().filter(|_| is_canonical(quat_wxyz));
    let orientation = orientation.ok_or(WireError::Orientation { sequence, quat_wxyz })?;
    let torque = match from {
        Role::Master => Signal::RenderedTorque,
        Role::Slave => Signal::EnvironmentTorque,
    };
    let angular_velocity = checked_axes(sequence, Signal::AngularVelocity, numbers.by_ref().take(3))?;
    let torque = checked_axes(sequence, torque, numbers)?;
    Ok(RotationState { orientation, angular_velocity, torque })
}

/// The next numbers, within the bound of their signal.
fn checked_axes<const N: usize>(
    sequence: u64,
    signal: Signal,
    numbers: impl Iterator<Item = f64>,
) -> Result<Axes<N>, WireError> {
    let value = Axes::<N>::from_iterator(numbers);
    signal.check(&value).map_err(|fault| WireError::Value(sequence, fault)).map(|()| value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::coupling::drawn::orientation;
    use proptest::prelude::*;

    const LAYOUT: FrameLayout =
        FrameLayout { kind: SideKind::Linear, has_gripper: false, has_buttons: false };

    fn frame() -> Frame<1> {
        Frame {
            role: Role::Slave,
            kind: SideKind::Linear,
            state: 2,
            hears_peer: true,
            clutch: true,
            run_id: 0x1122_3344_5566_7788,
            sequence: 5,
            sent_ns: 1_000_000,
            echo: Some(Echo { run_id: 11, sequence: 3, sent_ns: 7, held_ns: 9 }),
            position: Axes::<1>::new(-0.5),
            velocity: Axes::<1>::new(0.25),
            force: Axes::<1>::new(2.0),
            energy: PortEnergy { in_j: 1.5, out_j: 0.25 },
            rotation: None,
            gripper: None,
            buttons: None,
            ending: true,
            reason: 4,
            fault: 11,
            text: TextPiece { number: 3, index: 1, bytes: *b"bus is down\0" },
        }
    }

    /// The known answer, written down by hand from the table above.
    #[test]
    fn bytes_are_those_of_the_table() {
        let mut buffer = [0; MAX_FRAME];
        let bytes = frame().encode(&mut buffer);
        let mut expected = Vec::new();
        expected.extend_from_slice(b"HT\x05\x02\x11\x02\x0F\x00");
        expected.extend_from_slice(&[0x88, 0x77, 0x66, 0x55, 0x44, 0x33, 0x22, 0x11]);
        for number in [5_u64, 3, 1_000_000, 7, 9, 11] {
            expected.extend_from_slice(&number.to_le_bytes());
        }
        expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0xE0, 0xBF]); // -0.5
        expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0xD0, 0x3F]); // 0.25
        expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0x00, 0x40]); // 2.0
        expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0xF8, 0x3F]); // 1.5
        expected.extend_from_slice(&[0, 0, 0, 0, 0, 0, 0xD0, 0x3F]); // 0.25
        expected.extend_from_slice(b"\x04\x0B\x03\x01bus is down\x00");
        expected.extend_from_slice(&crc32fast::hash(&expected).to_le_bytes());
        assert_eq!(bytes, expected);
        assert_eq!(Frame::decode(bytes, Role::Slave, LAYOUT), Ok(frame()));
    }

    /// The gripper stands behind the energies, and lengthens every frame by 24 bytes.
    #[test]
    fn a_gripper_is_three_numbers_and_two_flags() {
        let state = GripperState { position: Some(0.5), velocity: -0.25, force_n: 2.0, holds_object: true };
        let mut buffer = [0; MAX_FRAME];
        let without = frame().encode(&mut buffer).to_vec();
        let framed = Frame { gripper: Some(state), ..frame() };
        let bytes = framed.encode(&mut buffer).to_vec();
        let mut expected = without[..104].to_vec();
        expected[6] |= 0x30;
        for number in [0.5_f64, -0.25, 2.0] {
            expected.extend_from_slice(&number.to_le_bytes());
        }
        expected.extend_from_slice(&without[104..120]);
        expected.extend_from_slice(&crc32fast::hash(&expected).to_le_bytes());
        assert_eq!(bytes, expected);
        let layout = FrameLayout { has_gripper: true, ..LAYOUT };
        assert_eq!(Frame::decode(&bytes, Role::Slave, layout), Ok(framed));
        let resealed = |change: &dyn Fn(&mut [u8])| {
            let mut bytes = bytes[..bytes.len() - CHECKSUM].to_vec();
            change(&mut bytes);
            bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
            Frame::<1>::decode(&bytes, Role::Slave, layout)
        };
        let unknown = Frame { gripper: Some(GripperState::default()), ..frame() };
        let blank = |bytes: &mut [u8]| {
            bytes[6] &= 0x0F;
            bytes[104..128].fill(0);
        };
        assert_eq!(resealed(&blank), Ok(unknown));
        for change in [
            &(|b: &mut [u8]| b[6] &= !0x10) as &dyn Fn(&mut [u8]),
            &|b| b[104..112].copy_from_slice(&1.001_f64.to_le_bytes()),
            &|b| b[104..112].copy_from_slice(&f64::NAN.to_le_bytes()),
            &|b| b[112..120].copy_from_slice(&101.0_f64.to_le_bytes()),
            &|b| b[120..128].copy_from_slice(&(-1.0_f64).to_le_bytes()),
            &|b| {
                blank(b);
                b[6] |= 0x20;
            },
            &|b| {
                blank(b);
                b[111] = 0x80; // -0.0
            },
        ] {
            assert!(matches!(resealed(change), Err(WireError::Gripper { sequence: 5, .. })));
        }
    }

    /// The rotation stands before the energies, the buttons behind gripper and before the cause.
    #[test]
    fn a_pose_is_ten_numbers_and_buttons_are_a_word() {
        let [x, y] = [0.6, 0.8];
        let state = RotationState {
            // -q of (0, 0.6, 0.8, 0): what is sent begins with a part above 0.
            orientation: nalgebra::Unit::new_unchecked(nalgebra::Quaternion::new(0.0, -x, -y, 0.0)),
            angular_velocity: Axes::<3>::new(1.0, -2.0, 3.0),
            torque: Axes::<3>::new(0.5, 0.25, -0.125),
        };
        let point = Frame {
            role: Role::Master,
            kind: SideKind::Linear,
            state: 2,
            hears_peer: true,
            clutch: true,
            run_id: 1,
            sequence: 5,
            sent_ns: 7,
            echo: None,
            position: Axes::<3>::new(1.0, 2.0, 3.0),
            velocity: Axes::<3>::new(4.0, 5.0, 6.0),
            force: Axes::<3>::new(7.0, 8.0, 9.0),
            rotation: None,
            energy: PortEnergy { in_j: 1.5, out_j: 0.25 },
            gripper: None,
            buttons: None,
            ending: false,
            reason: 0,
            fault: 0,
            text: TextPiece::default(),
        };
        let mut buffer = [0; MAX_FRAME];
        let without = point.encode(&mut buffer).to_vec();
        let framed =
            Frame { kind: SideKind::Pose, rotation: Some(state), buttons: Some(0x8000_0005), ..point };
        let bytes = framed.encode(&mut buffer).to_vec();
        let mut expected = without[..136].to_vec();
        expected[4] = 0x33;
        for number in [0.0, 0.6, 0.8, 0.0, 1.0, -2.0, 3.0, 0.5, 0.25, -0.125_f64] {
            expected.extend_from_slice(&number.to_le_bytes());
        }
        expected.extend_from_slice(&without[136..152]);
        expected.extend_from_slice(&[5, 0, 0, 0x80]);
        expected.extend_from_slice(&without[152..168]);
        expected.extend_from_slice(&crc32fast::hash(&expected).to_le_bytes());
        assert_eq!(bytes, expected);
        let layout = framed.layout();
        assert_eq!((layout.length(3), without.len()), (256, 172));
        let decoded = Frame::<3>::decode(&bytes, Role::Master, layout).unwrap();
        assert_eq!(decoded.encode(&mut buffer), bytes);
        assert_eq!(decoded.buttons, Some(0x8000_0005));
        let resealed = |role: u8, change: &dyn Fn(&mut [u8])| {
            let mut bytes = bytes[..bytes.len() - CHECKSUM].to_vec();
            bytes[3] = role;
            change(&mut bytes);
            bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
            let from = if role == 1 { Role::Master } else { Role::Slave };
            Frame::<3>::decode(&bytes, from, layout).unwrap_err()
        };
        let put =
            |at: usize, value: f64| move |b: &mut [u8]| b[at..at + 8].copy_from_slice(&value.to_le_bytes());
        for (at, value) in [(144, 0.601), (144, -0.6), (136, -0.0), (136, f64::NAN), (152, f64::INFINITY)] {
            let error = resealed(1, &put(at, value));
            assert!(matches!(error, WireError::Orientation { sequence: 5, .. }), "{at} {value}: {error}");
        }
        assert_eq!(
            resealed(1, &put(168, 1001.0)).to_string(),
            "frame 5: angular velocity exceeds 1000 rad/s"
        );
        assert_eq!(
            resealed(1, &put(192, f64::NAN)).to_string(),
            "frame 5: rendered torque is not a finite number"
        );
        assert_eq!(resealed(2, &|_| {}), WireError::Buttons { sequence: 5, buttons: 0x8000_0005 });
        let torque = |b: &mut [u8]| {
            put(192, -1e5)(b);
            b[232..236].fill(0);
        };
        assert_eq!(resealed(2, &torque).to_string(), "frame 5: environment torque exceeds 10000 N m");
        let kind = resealed(1, &|b| b[4] = 0x13);
        assert_eq!(kind.to_string(), "frame of kind 1: must be 3, pose");
    }

    #[test]
    fn the_checksum_is_the_common_one() {
        assert_eq!(crc32fast::hash(b"123456789"), 0xCBF4_3926);
    }

    #[test]
    fn refusals_name_what_was_seen() {
        let mut buffer = [0; MAX_FRAME];
        let good = frame().encode(&mut buffer).to_vec();
        let refuse = |change: &dyn Fn(&mut Vec<u8>)| {
            let mut bytes = good.clone();
            change(&mut bytes);
            Frame::<1>::decode(&bytes, Role::Slave, LAYOUT).unwrap_err()
        };
        assert_eq!(refuse(&|b| b.truncate(10)), WireError::Length { seen: 10, allowed: 124 });
        assert_eq!(refuse(&|b| b[0] = b'X'), WireError::Magic(*b"XT"));
        assert_eq!(refuse(&|b| b[2] = 9), WireError::Version(9));
        assert_eq!(refuse(&|b| b[3] = 1), WireError::Role(1));
        assert_eq!(refuse(&|b| b[4] = 0x13), WireError::Axes { seen: 3, allowed: 1 });
        assert_eq!(refuse(&|b| b[4] = 0x21), WireError::Kind { seen: 2, allowed: SideKind::Linear });
        assert!(matches!(refuse(&|b| b[60] ^= 4), WireError::Checksum { .. }));
        let resealed = |change: &dyn Fn(&mut [u8])| {
            let mut bytes = good[..good.len() - CHECKSUM].to_vec();
            change(&mut bytes);
            bytes.extend_from_slice(&crc32fast::hash(&bytes).to_le_bytes());
            Frame::<1>::decode(&bytes, Role::Slave, LAYOUT)
        };
        assert_eq!(resealed(&|b| b[6] = 0x1F), Err(WireError::Flags(0x1F)));
        assert_eq!(resealed(&|b| b[7] = 1), Err(WireError::Flags(0x10F)));
        assert_eq!(resealed(&|b| b[6] = 2), Err(WireError::Flags(2)));
        let silent = resealed(&|b| {
            b[6] = 14;
            b[24..32].fill(0);
            b[40..64].fill(0);
        });
        assert_eq!(silent, Ok(Frame { echo: None, ..frame() }));
        // Codes that this version does not know are passed on: they steer nothing.
        let unknown = resealed(&|b| (b[104], b[105]) = (255, 254));
        assert_eq!(unknown, Ok(Frame { reason: 255, fault: 254, ..frame() }));
        let text = |number, index| Err(WireError::Text { sequence: 5, number, index });
        assert_eq!(resealed(&|b| b[106] = 0), text(0, 1));
        assert_eq!(resealed(&|b| b[107] = 20), text(3, 20));
        assert_eq!(resealed(&|b| b[110] = 0), text(3, 1));
        // The last piece has the end in it.
        assert_eq!(resealed(&|b| (b[107], b[119]) = (19, b'!')), text(3, 19));
        assert_eq!(resealed(&|b| b[106..120].fill(0)), Ok(Frame { text: TextPiece::default(), ..frame() }));
        let mut bad = frame();
        bad.force[0] = f64::NAN;
        let error = Frame::<1>::decode(bad.encode(&mut buffer), Role::Slave, LAYOUT).unwrap_err();
        assert_eq!(error.to_string(), "frame 5: environment force is not a finite number");
    }

    proptest! {
        #[test]
        fn round_trip(
            numbers in prop::array::uniform9(-900.0..900.0f64),
            (run_id, sequence, sent_ns) in any::<(u64, u64, u64)>(),
            echo in prop::option::of(any::<(u64, u64, u64, u64)>()),
            (state, hears_peer, clutch) in any::<(u8, bool, bool)>(),
            (ending, reason, fault, number, index) in any::<(bool, u8, u8, u8, u8)>(),
            gripper in prop::option::of((prop::option::of(0.0..=1.0f64), -100.0..=100.0f64, 0.0..=1e4f64, any::<bool>())),
            (orientation, buttons) in (orientation(), prop::option::of(any::<u32>())),
        ) {
            let part = |i: usize| Axes::<3>::new(numbers[i], numbers[i + 1], numbers[i + 2]);
            let frame = Frame {
                role: Role::Master, kind: SideKind::Pose, state, hears_peer, clutch, run_id, sequence, sent_ns,
                echo: echo.map(|(run_id, sequence, sent_ns, held_ns)| Echo { run_id, sequence, sent_ns, held_ns }),
                position: part(0), velocity: part(3), force: part(6),
                rotation: Some(RotationState {
                    orientation, angular_velocity: part(2), torque: part(5),
                }),
                buttons,
                energy: PortEnergy { in_j: numbers[0].abs(), out_j: numbers[1].abs() },
                gripper: gripper.map(|(position, velocity, force_n, holds_object)| match position {
                    Some(_) => GripperState { position, velocity, force_n, holds_object },
                    None => GripperState::default(),
                }),
                ending, reason, fault,
                text: match number {
                    0 => TextPiece::default(),
                    _ => TextPiece { number, index: index % 19, bytes: [index | 1; PIECE] },
                },
            };
            let mut buffer = [0; MAX_FRAME];
            let decoded = Frame::decode(frame.encode(&mut buffer), Role::Master, frame.layout()).unwrap();
            // Of q and -q the canonical one comes back, with the same bits.
            let seen = decoded.rotation.unwrap().orientation;
            prop_assert_eq!(canonical(&seen), canonical(&orientation));
            let frame = Frame { rotation: decoded.rotation, ..frame };
            prop_assert_eq!(decoded, frame);
            prop_assert_eq!(decoded.rotation.unwrap().torque, part(5));
            prop_assert_eq!(decoded.rotation.unwrap().angular_velocity, part(2));
        }

        #[test]
        fn noise_is_refused_without_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(Frame::<2>::decode(&bytes, Role::Master, LAYOUT).is_err());
        }

        /// Random bodies under a right header and checksum: what is decoded is in range, the rest is refused.
        #[test]
        fn garbage_that_is_well_sealed_is_refused_or_in_range(
            body in prop::collection::vec(any::<u8>(), 124 - 8 - 4),
            values in prop::array::uniform5(prop::num::f64::ANY),
        ) {
            let mut bytes = vec![b'H', b'T', VERSION, 2, 0x11];
            bytes.extend_from_slice(&[1, 3, 0]);
            bytes.extend_from_slice(&body);
            for (slot, value) in values.iter().enumerate() {
                bytes[64 + 8 * slot..72 + 8 * slot].copy_from_slice(&value.to_le_bytes());
            }
            let checksum = crc32fast::hash(&bytes);
            bytes.extend_from_slice(&checksum.to_le_bytes());
            match Frame::<1>::decode(&bytes, Role::Slave, LAYOUT) {
                Ok(frame) => {
                    let bounds = [1e3, 1e3, 1e4, 1e9, 1e9];
                    let PortEnergy { in_j, out_j } = frame.energy;
                    let seen = [frame.position[0], frame.velocity[0], frame.force[0], in_j, out_j];
                    prop_assert!(seen.iter().zip(bounds).all(|(x, most)| x.abs() <= most));
                    prop_assert_eq!(seen, values);
                }
                Err(error) => prop_assert!(matches!(
                    error, WireError::Value(..) | WireError::Energy { .. } | WireError::Text { .. }
                ), "{error}"),
            }
        }

        #[test]
        fn one_flipped_bit_is_refused(bit in 0usize..124 * 8) {
            let mut buffer = [0; MAX_FRAME];
            let mut bytes = frame().encode(&mut buffer).to_vec();
            bytes[bit / 8] ^= 1 << (bit % 8);
            prop_assert!(Frame::<1>::decode(&bytes, Role::Slave, LAYOUT).is_err());
        }
    }
}
