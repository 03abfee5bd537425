//! Frame that master and slave exchange, byte for byte.
//!
//! All numbers are little-endian. A frame of N axes has `HEADER + 32 N + 54` bytes, plus 104 of kind `pose`,
//! 24 with a gripper and 4 with buttons. All frames of a session have the same length:
//!
//! | offset | type | field |
//! |---|---|---|
//! | 0 | `[u8; 2]` | magic, `HT` |
//! | 2 | `u8` | version, 7 |
//! | 3 | `u8` | role of the sender: 1 master, 2 slave |
//! | 4 | `u8` | axes N, and 16 times the kind: 1 linear, 2 joints, 3 pose |
//! | 5 | `u8` | state of the sender's ladder |
//! | 6 | `u16` | flags: bit 0, the echo is valid; bit 1, the sender hears the peer; bit 2, its clutch is closed; bit 3, it ends; bit 4, the state of its gripper or trigger is known; bit 5, its gripper holds something; bit 6, of a slave only, its gripper follows the trigger; bits 8 to 11, the coupling, [`CouplingKind::code`] |
//! | 8 | `u64` | run id: drawn by the sender when it starts |
//! | 16 | `u64` | sequence, from 0, one more with each frame |
//! | 24 | `u64` | echo: newest sequence received from the peer |
//! | 32 | `u64` | time of sending, sender's monotonic clock in ns |
//! | 40 | `u64` | echo: time of sending of that frame, the peer's clock in ns |
//! | 48 | `u64` | echo: time in ns since that frame arrived |
//! | 56 | `u64` | echo: run id of that frame |
//! | 64 | `[f64; N]` | position in m (rad) |
//! | 64 + 8 N | `[f64; N]` | velocity in m/s (rad/s) |
//! | 64 + 16 N | `[f64; N]` | force in N (N m): master, `F_device`, or `F_h` in the frame of the slave over `lambda_f` for a coupling that uses it; slave, force of the environment |
//! | 64 + 24 N | `[f64; 4]` | only of kind `pose`; the following fields are then 80 bytes later: orientation, unit quaternion w, x, y, z |
//! | 96 + 24 N | `[f64; 3]` | angular velocity in rad/s |
//! | 120 + 24 N | `[f64; 3]` | torque in N m: master, of the device; slave, of the environment |
//! | 64 + 24 N | `f64` | energy in J that this side's plant has put into the link since its engagement; it never falls during one |
//! | 72 + 24 N | `f64` | energy in J that this side's plant has had out of the link, likewise |
//! | 80 + 24 N | `[f64; N]` | vector of the coupling, [`CouplingMessage::vector`]; zeros of position-force |
//! | 80 + 32 N | `[f64; 3]` | only of kind `pose`; the following fields are then 24 bytes later: the same for the rotation |
//! | 80 + 32 N | `[f64; 2]` | energies of the coupling in J, of translation and rotation; zeros of couplings without them |
//! | 96 + 32 N | `[f64; 3]` | only with a gripper; the following fields are then 24 bytes later: position of gripper or trigger, 0 open to 1 closed; velocity in 1/s; force in N |
//! | 96 + 32 N | `u32` | only with buttons; the following fields are then 4 bytes later: bit n, button n of the master is pressed; 0 of a slave |
//! | 96 + 32 N | `u16` | count of the sender's engagements, from 1; 0 while its half of the coupling is not engaged |
//! | 98 + 32 N | `u8` | reason of the sender's state, [`crate::Reason::code`]; 0 in the initial state |
//! | 99 + 32 N | `u8` | its fault, [`haptether_safety::Fault::code`]; 0 without |
//! | 100 + 32 N | `u8` | number of its fault's text, 1 to 255; 0 without |
//! | 101 + 32 N | `u8` | which piece of that text follows, 0 to 19 |
//! | 102 + 32 N | `[u8; 12]` | that piece, UTF-8; zeros after the end of the text |
//! | 114 + 32 N | `u32` | CRC-32 (IEEE) of all bytes before |
//!
//! A frame has exactly one encoding. Flags without a meaning are zero. The fields of an invalid echo, an
//! unknown gripper, a missing text and a coupling that is not engaged are zero, and so are the bytes after the end of a
//! text. The quaternion
//! is the one of q and -q that [`crate::coupling::canonical`] returns, of norm 1 to 1e-9.
//!
//! Codes of reasons and faults control nothing: an unknown code is passed on and shown as a number.
//!
//! The scene fixes the parts of a frame in advance: [`FrameLayout`]. A frame of another layout is rejected.
//!
//! Positions are absolute, never increments: a lost frame loses only its own content.

use std::borrow::Cow;

use haptether_safety::{Axes, Signal};
use zerocopy::{
    FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned,
    little_endian::{U16, U64},
};

use crate::{
    SideKind,
    coupling::{CouplingKind, GripperState, RotationState, Sends, canonical, checked, is_canonical},
    fault_text::{PIECE, TextPiece},
    port::{CouplingMessage, MAX_ENERGY_J, PortEnergy, PortState},
};

pub use crate::port::{MAX_AXES, Padded, padded, unpadded};

/// Magic bytes at the start of a frame.
pub const MAGIC: [u8; 2] = *b"HT";
/// Version of the frame.
pub const VERSION: u8 = 7;
/// Bytes before the first axis.
pub const HEADER: usize = 64;
const ENERGIES: usize = 16;
/// Numbers of the rotation of a pose: quaternion, angular velocity, torque.
const ROTATION: usize = 10;
const GRIPPER: usize = 24;
const BUTTONS: usize = 4;
/// Numbers of a coupling beside those per axis, and those of a rotation.
const SUMS: usize = 2;
const TURNED: usize = 3;
const EPOCH: usize = 2;
/// Bytes of reason, fault and fault text.
const CAUSE: usize = 4 + PIECE;
const CHECKSUM: usize = 4;
/// Bytes of the longest frame: seven joints need more than three axes with an orientation.
pub const MAX_FRAME: usize =
    FrameLayout { kind: SideKind::Joints, has_gripper: true, has_buttons: true, ..FrameLayout::of(MAX_AXES) }
        .length();

/// Parts of every frame of a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameLayout {
    /// Number of axes, 1 to [`MAX_AXES`].
    pub axes: usize,
    /// Kind of coordinates; a pose includes a rotation.
    pub kind: SideKind,
    /// True with a gripper and a trigger.
    pub has_gripper: bool,
    /// True with buttons at the master.
    pub has_buttons: bool,
    /// Coupling of the two sides.
    pub coupling: CouplingKind,
}

impl FrameLayout {
    /// Layout of points along `axes` axes, without gripper and buttons.
    pub const fn of(axes: usize) -> Self {
        debug_assert!(axes <= MAX_AXES);
        Self {
            axes,
            kind: SideKind::Linear,
            has_gripper: false,
            has_buttons: false,
            coupling: CouplingKind::PositionForce,
        }
    }

    /// Length of a frame in bytes.
    pub const fn length(self) -> usize {
        let rotation = if matches!(self.kind, SideKind::Pose) { 8 * (ROTATION + TURNED) } else { 0 };
        let coupling = 8 * (self.axes + SUMS) + EPOCH;
        let gripper = if self.has_gripper { GRIPPER } else { 0 };
        let buttons = if self.has_buttons { BUTTONS } else { 0 };
        HEADER + 24 * self.axes + rotation + ENERGIES + coupling + gripper + buttons + CAUSE + CHECKSUM
    }

    /// Form of the frames, which both sides exchange in the handshake.
    #[allow(clippy::cast_possible_truncation)] // at most 7 axes
    pub const fn form(self) -> FrameForm {
        let parts =
            (self.has_gripper as u16) << 6 | (self.has_buttons as u16) << 7 | self.coupling.code() << 8;
        FrameForm((VERSION as u16) << 12 | parts | (self.kind.code() as u16) << 3 | self.axes as u16)
    }
}

/// Form of a side's frames in the handshake: bits 0 to 2 axes, 3 to 5 kind, 6 gripper, 7 buttons, 8 to 11 the
/// coupling, 12 to 15 version.
///
/// Before version 5 the number was the length in bytes; such a side therefore shows version 0.
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
        let coupling = CouplingKind::from_code(form >> 8 & 15).map_or("unknown", CouplingKind::name);
        write!(
            f,
            "of kind {}, {} axes and coupling {coupling}{gripper}{buttons}",
            kind.map_or("unknown", SideKind::name),
            form & 7
        )
    }
}

/// Role of a frame's sender.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The side of the hand.
    Master,
    /// The side of the robot.
    Slave,
}

impl Role {
    /// Name: "master" or "slave".
    pub const fn name(self) -> &'static str {
        match self {
            Self::Master => "master",
            Self::Slave => "slave",
        }
    }

    /// Role of the other side.
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

/// Echo of the peer's newest frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Echo {
    /// Run id of that frame; an echo of another run does not concern the receiver.
    pub run_id: u64,
    /// Sequence of that frame.
    pub sequence: u64,
    /// Time of sending of that frame, on the peer's clock in ns.
    pub sent_ns: u64,
    /// Time in ns since that frame arrived.
    pub held_ns: u64,
}

/// Decoded frame. Fields are in order of use, so that a frame of few axes without gripper and rotation needs
/// few cache lines.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(C)]
pub struct Frame {
    /// Role of the sender.
    pub role: Role,
    /// Kind of coordinates.
    pub kind: SideKind,
    /// State of the sender's ladder, [`crate::LadderState::code`].
    pub state: u8,
    /// True if the sender has heard the peer recently enough to stay engaged.
    pub hears_peer: bool,
    /// True if the clutch is closed: the master's button; a slave has none.
    pub clutch: bool,
    /// True if this is one of the sender's last frames before an orderly end.
    pub ending: bool,
    /// Reason of the sender's state, [`crate::Reason::code`]; 0 in the initial state.
    pub reason: u8,
    /// Fault of the sender, [`haptether_safety::Fault::code`]; 0 without one.
    pub fault: u8,
    /// Coupling of the session.
    pub coupling: CouplingKind,
    /// Number of axes.
    pub axes: usize,
    /// Run id, drawn by the sender at its start.
    pub run_id: u64,
    /// Sequence, from 0, one more with each frame.
    pub sequence: u64,
    /// Time of sending in ns, sender's monotonic clock.
    pub sent_ns: u64,
    /// Echo of the sender's newest received frame.
    pub echo: Option<Echo>,
    /// Piece of the text on the sender's fault.
    pub text: TextPiece,
    /// Buttons of the master: bit n is set while button n is pressed; none in a session without buttons.
    pub buttons: Option<u32>,
    /// Energies into and out of the link at the sender's port.
    pub energy: PortEnergy,
    /// Gripper or trigger; none in a session without a gripper.
    pub gripper: Option<GripperState>,
    /// Position in m.
    pub position: Padded,
    /// Velocity in m/s.
    pub velocity: Padded,
    /// Force in N.
    pub force: Padded,
    /// Numbers of the coupling.
    pub message: CouplingMessage,
    /// Orientation, angular velocity and torque; only of kind `pose`.
    pub rotation: Option<RotationState>,
}

/// Copy the values of the first `axes` axes. The others are zero in both.
#[inline(always)]
fn copy_axes(to: &mut Padded, from: &Padded, axes: usize) {
    to.as_mut_slice()[..axes].copy_from_slice(&from.as_slice()[..axes]);
}

/// Rejection of a datagram that is not a valid frame. It changes no state and is only counted.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum WireError {
    /// Wrong length.
    #[error("frame of {seen} bytes: must have {allowed}")]
    Length {
        /// Bytes received.
        seen: usize,
        /// Bytes of a frame of this session.
        allowed: usize,
    },
    /// Other protocol.
    #[error("magic {0:?}: must be {MAGIC:?}")]
    Magic([u8; 2]),
    /// Other version.
    #[error("frame version {0}: must be {VERSION}")]
    Version(u8),
    /// Wrong sender.
    #[error("sender role {0}: must be the peer's")]
    Role(u8),
    /// Wrong number of axes.
    #[error("frame of {seen} axes: must have {allowed}")]
    Axes {
        /// Axes of the frame.
        seen: u8,
        /// Axes of this endpoint.
        allowed: usize,
    },
    /// Wrong kind.
    #[error("frame of kind {seen}: must be {}, {}", .allowed.code(), .allowed.name())]
    Kind {
        /// Kind of the frame: 1 linear, 2 joints, 3 pose.
        seen: u8,
        /// Kind of this endpoint.
        allowed: SideKind,
    },
    /// Other coupling.
    #[error("frame of coupling {seen}: must be {}, {}", .allowed.code(), .allowed.name())]
    Coupling {
        /// Code of the coupling in the frame.
        seen: u16,
        /// Coupling of this endpoint.
        allowed: CouplingKind,
    },
    /// Numbers of the coupling out of range, or not zero although it is not engaged or does not use them.
    #[error("frame {sequence}: {message:?}: must be in range, and zero where coupling {} does not use it", .coupling.name())]
    Message {
        /// Sequence of the frame.
        sequence: u64,
        /// Coupling of the session.
        coupling: CouplingKind,
        /// Received value.
        message: CouplingMessage,
    },
    /// Flags without a meaning, or an echo although its flag is not set.
    #[error(
        "flags {0:#06x}: must be a sum of 1, 2, 4 and 8, with a gripper also 16, 32 \
         and (slave only) 64; without 1 the echo must be zero"
    )]
    Flags(u16),
    /// Damaged in transit.
    #[error("checksum {seen:#010x}: must be {computed:#010x}")]
    Checksum {
        /// Checksum in the frame.
        seen: u32,
        /// Checksum of the received bytes.
        computed: u32,
    },
    /// Number that is not finite or out of range.
    #[error("frame {0}: {1}")]
    Value(u64, haptether_safety::Fault),
    /// Quaternion that is not a unit quaternion, or not canonical.
    #[error(
        "frame {sequence}: orientation {quat_wxyz:?}: must have a norm of 1 to \
         within 1e-9, and its first non-zero part must be positive"
    )]
    Orientation {
        /// Sequence of the frame.
        sequence: u64,
        /// Received value.
        quat_wxyz: [f64; 4],
    },
    /// Buttons in a frame of a slave.
    #[error("frame {sequence}: buttons {buttons:#x} of a slave: must be 0")]
    Buttons {
        /// Sequence of the frame.
        sequence: u64,
        /// Received value.
        buttons: u32,
    },
    /// Energies out of range.
    #[error("frame {sequence}: energies {energy:?}: must be between 0 and {MAX_ENERGY_J} J")]
    Energy {
        /// Sequence of the frame.
        sequence: u64,
        /// Received value.
        energy: PortEnergy,
    },
    /// Gripper state out of range.
    #[error(
        "frame {sequence}: gripper {state:?}: must be at 0 to 1, within 100 1/s and 0 to 10000 N, or all unknown"
    )]
    Gripper {
        /// Sequence of the frame.
        sequence: u64,
        /// Received value.
        state: GripperState,
    },
    /// Piece of a text that is not in its only encoding.
    #[error(
        "frame {sequence}: piece {index} of text {number}: must be piece 0 to 19 \
         of text 1 to 255 with zeros after its end, or all zeros"
    )]
    Text {
        /// Sequence of the frame.
        sequence: u64,
        /// Number of the text.
        number: u8,
        /// Index of the piece.
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
    /// Return an error unless the header is of the peer and of this session's kind and axes.
    fn check(&self, from: Role, layout: FrameLayout) -> Result<(), WireError> {
        let FrameLayout { axes, kind, coupling, .. } = layout;
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
        let seen = self.flags.get() >> COUPLING_BIT & 15;
        if seen != coupling.code() {
            return Err(WireError::Coupling { seen, allowed: coupling });
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
const FOLLOWS: u16 = 64;
/// First bit of the coupling's code in the flags.
const COUPLING_BIT: u16 = 8;
/// Offset of the flags.
const FLAGS: usize = 6;

/// Return the code of the coupling in an encoded frame; 0 if it is too short.
pub(crate) fn coupling_code(bytes: &[u8]) -> u16 {
    let flags = bytes.get(FLAGS..FLAGS + 2).and_then(|flags| flags.first_chunk());
    flags.map_or(0, |flags| u16::from_le_bytes(*flags) >> COUPLING_BIT & 15)
}

/// Return whether the sender of an encoded frame hears its peer; the frame must have been decoded before.
pub(crate) fn hears_peer(frame: &[u8]) -> bool {
    frame.get(6).is_some_and(|flags| u16::from(*flags) & HEARS_PEER != 0)
}

const NO_NUMBERS: nalgebra::ArrayStorage<f64, MAX_AXES, 1> = nalgebra::ArrayStorage([[0.0; MAX_AXES]]);
/// Echo of a frame without an echo.
const NO_ECHO: Echo = Echo { run_id: 0, sequence: 0, sent_ns: 0, held_ns: 0 };

impl Frame {
    /// Layout of this frame.
    pub const fn layout(&self) -> FrameLayout {
        let Self { axes, kind, coupling, gripper, buttons, .. } = self;
        FrameLayout {
            axes: *axes,
            kind: *kind,
            coupling: *coupling,
            has_gripper: gripper.is_some(),
            has_buttons: buttons.is_some(),
        }
    }

    fn flags(&self) -> u16 {
        let gripper = self.gripper.unwrap_or_default();
        (if self.echo.is_some() { ECHO_VALID } else { 0 })
            | if self.hears_peer { HEARS_PEER } else { 0 }
            | if self.clutch { CLUTCH } else { 0 }
            | if self.ending { ENDING } else { 0 }
            | if gripper.position.is_some() { GRIPPER_KNOWN } else { 0 }
            | if gripper.holds_object { HOLDS_OBJECT } else { 0 }
            | if gripper.follows { FOLLOWS } else { 0 }
            | self.coupling.code() << COUPLING_BIT
    }

    /// Return whether the vector of this frame of a slave is a motion.
    pub(crate) fn sends_motion(&self) -> bool {
        self.coupling.compares_motions()
    }

    /// Quaternion, angular velocity and torque as encoded; only of kind `pose`.
    fn rotation_numbers(&self) -> Option<[f64; ROTATION]> {
        (self.kind == SideKind::Pose).then(|| {
            let RotationState { orientation, angular_velocity, torque } = self.rotation.unwrap_or_default();
            let mut numbers = [0.0; ROTATION];
            numbers[..4].copy_from_slice(&canonical(&orientation));
            numbers[4..7].copy_from_slice(angular_velocity.as_slice());
            numbers[7..].copy_from_slice(torque.as_slice());
            numbers
        })
    }

    /// Position, velocity and force as encoded; only with gripper or trigger.
    fn gripper_numbers(&self) -> Option<[f64; 3]> {
        self.gripper.map(|state| [state.position.unwrap_or(0.0), state.velocity, state.force_n])
    }

    /// Encode the frame and return the bytes written.
    pub fn encode<'a>(&self, buffer: &'a mut [u8; MAX_FRAME]) -> &'a [u8] {
        let echo = self.echo.unwrap_or(NO_ECHO);
        let (axes, length) = (self.axes, self.layout().length());
        #[allow(clippy::cast_possible_truncation)] // at most 7 axes
        let header = Header {
            magic: MAGIC,
            version: VERSION,
            role: self.role.byte(),
            axes: axes as u8 | self.kind.code() << 4,
            state: self.state,
            flags: U16::new(self.flags()),
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
        let mut slots = buffer[HEADER..].chunks_exact_mut(8);
        let mut put = |values: &[f64]| {
            for (value, slot) in values.iter().zip(&mut slots) {
                slot.copy_from_slice(&value.to_le_bytes());
            }
        };
        for part in [&self.position, &self.velocity, &self.force] {
            put(&part.as_slice()[..axes]);
        }
        if let Some(numbers) = self.rotation_numbers() {
            put(&numbers);
        }
        put(&energies);
        put(&self.message.vector.as_slice()[..axes]);
        if self.kind == SideKind::Pose {
            put(self.message.turned.as_slice());
        }
        put(&self.message.sums);
        if let Some(jaws) = self.gripper_numbers() {
            put(&jaws);
        }
        let end = length - CHECKSUM;
        let TextPiece { number, index, bytes } = self.text;
        let cause = &mut buffer[end - CAUSE..end];
        cause[..4].copy_from_slice(&[self.reason, self.fault, number, index]);
        cause[4..].copy_from_slice(&bytes);
        let end_of_buttons = end - CAUSE - EPOCH;
        buffer[end_of_buttons..end - CAUSE].copy_from_slice(&self.message.epoch.to_le_bytes());
        if let Some(buttons) = self.buttons {
            buffer[end_of_buttons - BUTTONS..end_of_buttons].copy_from_slice(&buttons.to_le_bytes());
        }
        let checksum = crc32fast::hash(&buffer[..end]);
        buffer[end..length].copy_from_slice(&checksum.to_le_bytes());
        &buffer[..length]
    }

    /// Decode a frame from the peer of role `from`; cheap checks come first.
    pub fn decode(bytes: &[u8], from: Role, layout: FrameLayout) -> Result<Self, WireError> {
        let FrameLayout { axes, kind, has_gripper, has_buttons, coupling } = layout;
        let length = || WireError::Length { seen: bytes.len(), allowed: layout.length() };
        if bytes.len() != layout.length() {
            return Err(length());
        }
        let (header, _) = Header::read_from_prefix(bytes).map_err(|_| length())?;
        header.check(from, layout)?;
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
        if !(is_valid || echo == NO_ECHO) {
            return Err(WireError::Flags(flags));
        }
        let (numbers, cause) = body.split_at(body.len() - CAUSE);
        let (numbers, epoch) = numbers.split_at(numbers.len() - EPOCH);
        let epoch = epoch.first_chunk().map_or(0, |bytes| u16::from_le_bytes(*bytes));
        let word = numbers.last_chunk().map_or(0, |bytes| u32::from_le_bytes(*bytes));
        let numbers = |first: usize| {
            numbers[HEADER + 8 * first..].chunks_exact(8).map(|bytes| {
                let mut value = [0; 8];
                value.copy_from_slice(bytes);
                f64::from_le_bytes(value)
            })
        };
        let part = |index: usize| {
            let mut part = Padded::zeros();
            part.iter_mut().zip(numbers(axes * index).take(axes)).for_each(|(slot, value)| *slot = value);
            part
        };
        let is_pose = kind == SideKind::Pose;
        let mut rest = numbers(3 * axes + if is_pose { ROTATION } else { 0 });
        let energy =
            PortEnergy { in_j: rest.next().unwrap_or(f64::NAN), out_j: rest.next().unwrap_or(f64::NAN) };
        let mut message = CouplingMessage { epoch, ..CouplingMessage::default() };
        let turned = if is_pose { TURNED } else { 0 };
        let of_message = message.vector.as_mut_slice()[..axes].iter_mut();
        let of_message =
            of_message.chain(&mut message.turned.as_mut_slice()[..turned]).chain(&mut message.sums);
        of_message.for_each(|slot| *slot = rest.next().unwrap_or(f64::NAN));
        let gripper = has_gripper.then(|| std::array::from_fn(|_| rest.next().unwrap_or(f64::NAN)));
        let mut turn = numbers(3 * axes);
        let rotation = is_pose.then(|| std::array::from_fn(|_| turn.next().unwrap_or(f64::NAN)));
        let mut text = TextPiece { number: cause[2], index: cause[3], bytes: [0; PIECE] };
        text.bytes.copy_from_slice(&cause[4..]);
        Self {
            role: from,
            axes,
            kind,
            coupling,
            message,
            state: header.state,
            hears_peer: flags & HEARS_PEER != 0,
            clutch: flags & CLUTCH != 0,
            run_id: header.run_id.get(),
            sequence,
            sent_ns: header.sent_ns.get(),
            echo: is_valid.then_some(echo),
            position: part(0),
            velocity: part(1),
            force: part(2),
            rotation: None,
            energy,
            gripper: None,
            buttons: has_buttons.then_some(word),
            ending: flags & ENDING != 0,
            reason: cause[0],
            fault: cause[1],
            text,
        }
        .admitted(flags, gripper, rotation)
    }

    /// Copy `other`, a frame of `count` axes, field by field. Rare fields are long and are copied only if
    /// present; a reader of one field need not wait for all.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    pub(crate) fn replace(&mut self, other: &Self, count: usize) {
        // By reference: fields that are not assigned are not read.
        let Self {
            role,
            axes,
            kind,
            coupling,
            message,
            state,
            hears_peer,
            clutch,
            run_id,
            sequence,
            sent_ns,
            echo,
            position,
            velocity,
            force,
            rotation,
            energy,
            gripper,
            buttons,
            ending,
            reason,
            fault,
            text,
        } = other;
        self.change_coupling(*coupling);
        (self.role, self.axes, self.kind) = (*role, *axes, *kind);
        self.message.replace(message, *coupling);
        (self.state, self.hears_peer) = (*state, *hears_peer);
        (self.clutch, self.ending, self.reason, self.fault) = (*clutch, *ending, *reason, *fault);
        (self.run_id, self.sequence, self.sent_ns, self.echo) = (*run_id, *sequence, *sent_ns, *echo);
        copy_axes(&mut self.position, position, count);
        copy_axes(&mut self.velocity, velocity, count);
        copy_axes(&mut self.force, force, count);
        (self.energy, self.buttons, self.text) = (*energy, *buttons, *text);
        if rotation.is_some() || self.rotation.is_some() {
            self.rotation = *rotation;
        }
        if gripper.is_some() || self.gripper.is_some() {
            self.gripper = *gripper;
        }
    }

    /// Set the coupling. Numbers of another one do not stay.
    #[inline(always)] // takes and makes a frame: docs/decisions/060-ticks-in-a-row.md
    pub(crate) fn change_coupling(&mut self, coupling: CouplingKind) {
        if self.coupling != coupling {
            (self.coupling, self.message) = (coupling, CouplingMessage::ZERO);
        }
    }

    /// Frame without content, to be filled.
    pub(crate) const EMPTY: Self = Self {
        role: Role::Master,
        kind: SideKind::Linear,
        state: 0,
        hears_peer: false,
        clutch: false,
        ending: false,
        reason: 0,
        fault: 0,
        coupling: CouplingKind::PositionForce,
        axes: 0,
        run_id: 0,
        sequence: 0,
        sent_ns: 0,
        echo: None,
        text: TextPiece { number: 0, index: 0, bytes: [0; PIECE] },
        buttons: None,
        energy: PortEnergy { in_j: 0.0, out_j: 0.0 },
        message: CouplingMessage::ZERO,
        gripper: None,
        position: Padded::from_array_storage(NO_NUMBERS),
        velocity: Padded::from_array_storage(NO_NUMBERS),
        force: Padded::from_array_storage(NO_NUMBERS),
        rotation: None,
    };

    /// Copy the numbers of a port of `axes` axes.
    #[inline(always)] // makes a frame: docs/decisions/060-ticks-in-a-row.md
    pub(crate) fn take_port(&mut self, port: &PortState, axes: usize) {
        copy_axes(&mut self.position, &port.position, axes);
        copy_axes(&mut self.velocity, &port.velocity, axes);
        copy_axes(&mut self.force, &port.force, axes);
        self.energy = port.energy;
        self.message.replace(&port.message, self.coupling);
    }

    /// Return whether the frame has neither gripper nor rotation; decoding then leaves it
    /// unchanged.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    pub(crate) fn is_plain(&self) -> bool {
        self.gripper.is_none() && self.rotation.is_none() && self.kind != SideKind::Pose
    }

    /// Check a [plain](Self::is_plain) frame of the right layout and role; without a gripper its flags are
    /// always valid.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    pub(crate) fn check_plain(&self, axes: usize) -> Result<(), WireError> {
        self.check_energy()?;
        if self.coupling != CouplingKind::PositionForce {
            self.check_message()?;
        }
        self.check_body(axes)
    }

    /// Return the result of [`encode`](Self::encode) followed by [`decode`](Self::decode), bit-identical and
    /// with the same errors, but without the bytes. For a network that does not read the bytes.
    pub fn received(&self, from: Role, layout: FrameLayout) -> Result<Cow<'_, Self>, WireError> {
        let own = self.layout();
        if own != layout && own.length() != layout.length() {
            return Err(WireError::Length { seen: own.length(), allowed: layout.length() });
        }
        if self.role != from {
            return Err(WireError::Role(self.role.byte()));
        }
        if own.axes != layout.axes {
            #[allow(clippy::cast_possible_truncation)] // at most 7
            return Err(WireError::Axes { seen: own.axes as u8, allowed: layout.axes });
        }
        if own.kind != layout.kind {
            return Err(WireError::Kind { seen: own.kind.code(), allowed: layout.kind });
        }
        if own.coupling != layout.coupling {
            return Err(WireError::Coupling { seen: own.coupling.code(), allowed: layout.coupling });
        }
        if own != layout {
            // Same length but other parts: decode the bytes with the other layout.
            return Self::decode(self.encode(&mut [0; MAX_FRAME]), from, layout).map(Cow::Owned);
        }
        if self.is_plain() {
            self.check_plain(MAX_AXES)?;
            return Ok(Cow::Borrowed(self));
        }
        self.admitted(self.flags(), self.gripper_numbers(), self.rotation_numbers()).map(Cow::Owned)
    }

    /// Return the frame with decoded gripper and rotation, if all its numbers are valid.
    fn admitted(
        mut self,
        flags: u16,
        gripper: Option<[f64; 3]>,
        rotation: Option<[f64; ROTATION]>,
    ) -> Result<Self, WireError> {
        let (sequence, from) = (self.sequence, self.role);
        self.check_head(flags, gripper.is_some())?;
        self.gripper = gripper.map(|numbers| decoded_gripper(sequence, flags, numbers)).transpose()?;
        self.rotation =
            rotation.map(|numbers| decoded_rotation(sequence, from, numbers.into_iter())).transpose()?;
        self.check_message()?;
        self.check_body(MAX_AXES)?;
        Ok(self)
    }

    /// Check the fields that precede gripper and rotation.
    #[inline]
    fn check_head(&self, flags: u16, has_gripper: bool) -> Result<(), WireError> {
        let of_gripper = match (has_gripper, self.role) {
            (true, Role::Slave) => GRIPPER_KNOWN | HOLDS_OBJECT | FOLLOWS,
            (true, Role::Master) => GRIPPER_KNOWN | HOLDS_OBJECT,
            (false, _) => 0,
        };
        if flags & !(ECHO_VALID | HEARS_PEER | CLUTCH | ENDING | of_gripper | 15 << COUPLING_BIT) != 0 {
            return Err(WireError::Flags(flags));
        }
        self.check_energy()
    }

    #[inline]
    fn check_energy(&self) -> Result<(), WireError> {
        let Self { sequence, energy, .. } = *self;
        if energy.is_possible() { Ok(()) } else { Err(WireError::Energy { sequence, energy }) }
    }

    /// Check the numbers of the coupling: in range, and zero where it does not use them.
    #[inline(never)]
    fn check_message(&self) -> Result<(), WireError> {
        let Self { sequence, role, coupling, message, .. } = self;
        let CouplingMessage { epoch, vector, turned, sums } = message;
        let (bound, turn_bound) = match (coupling.sends(*role), *epoch) {
            (None, _) | (_, 0) => (0.0, 0.0),
            (Some(Sends::Force), _) => (Signal::EnvironmentForce.bound(), Signal::EnvironmentTorque.bound()),
            (Some(Sends::Motion), _) => (Signal::Position.bound(), std::f64::consts::PI),
            (Some(Sends::Wave), _) => (MAX_ENERGY_J, MAX_ENERGY_J),
        };
        let sum_bound = if *epoch != 0 && coupling.sends_energy() { MAX_ENERGY_J } else { 0.0 };
        let rises = sums.iter().all(|sum| sum.is_sign_positive());
        let within = |values: &[f64], bound: f64| {
            let zero = |value: &f64| value.to_bits() == 0;
            values.iter().all(|value| if bound == 0.0 { zero(value) } else { value.abs() <= bound })
        };
        if within(vector.as_slice(), bound)
            && within(turned.as_slice(), turn_bound)
            && within(sums, sum_bound)
            && rises
        {
            return Ok(());
        }
        Err(WireError::Message { sequence: *sequence, coupling: *coupling, message: *message })
    }

    /// Check the remaining fields.
    #[inline(always)] // takes a frame: docs/decisions/060-ticks-in-a-row.md
    fn check_body(&self, axes: usize) -> Result<(), WireError> {
        let (sequence, from) = (self.sequence, self.role);
        if let (Role::Slave, Some(buttons @ 1..)) = (from, self.buttons) {
            return Err(WireError::Buttons { sequence, buttons });
        }
        if !self.text.is_canonical() {
            return Err(WireError::Text { sequence, number: self.text.number, index: self.text.index });
        }
        let force = match from {
            Role::Master => Signal::RenderedForce,
            Role::Slave => Signal::EnvironmentForce,
        };
        for (signal, value) in
            [(Signal::Position, &self.position), (Signal::Velocity, &self.velocity), (force, &self.force)]
        {
            let bound = signal.bound();
            if !value.as_slice()[..axes].iter().fold(true, |all, x| all & (x.abs() <= bound)) {
                signal.check(value).map_err(|fault| WireError::Value(sequence, fault))?;
            }
        }
        Ok(())
    }
}

/// Decode a gripper or a trigger, known or unknown.
fn decoded_gripper(sequence: u64, flags: u16, numbers: [f64; 3]) -> Result<GripperState, WireError> {
    // Only +0 counts as zero, so that there is one encoding.
    let is_unknown = numbers.iter().all(|value| value.to_bits() == 0);
    let is_known = flags & GRIPPER_KNOWN != 0;
    let [position, velocity, force_n] = numbers;
    let position = (is_known || !is_unknown).then_some(position);
    let (holds_object, follows) = (flags & HOLDS_OBJECT != 0, flags & FOLLOWS != 0);
    let state = GripperState { position, velocity, force_n, holds_object, follows };
    if state.is_possible() && state.position.is_some() == is_known {
        Ok(state)
    } else {
        Err(WireError::Gripper { sequence, state })
    }
}

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

/// Take the next numbers, and check them against the bound of their signal.
fn checked_axes<const N: usize>(
    sequence: u64,
    signal: Signal,
    numbers: impl Iterator<Item = f64>,
) -> Result<Axes<N>, WireError> {
    let value = Axes::<N>::from_iterator(numbers);
    signal.check(&value).map_err(|fault| WireError::Value(sequence, fault)).map(|()| value)
}

#[cfg(test)]
mod tests;
