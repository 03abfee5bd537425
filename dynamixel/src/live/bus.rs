//! Instructions and their answers, with deadlines.

use std::{path::Path, sync::Arc};

use rustix::io::Errno;

use super::{
    port::{SerialPort, now_ns, sleep_ns},
    stops::Stops,
};
use crate::{
    error::StatusError,
    instruction::{BROADCAST, Instruction, Packet, RequestError},
    parser::{FrameError, Received, StatusParser},
    sync_read::{Progress, SyncRead, SyncReadError},
};

/// Start bit, eight bits, stop bit.
const BITS_PER_BYTE: u64 = 10;
/// Size of a status packet without parameters, in bytes.
const STATUS_OVERHEAD: usize = 11;
const SECOND_NS: u64 = 1_000_000_000;
/// Number of times a stop is sent, because it is not answered.
const STOPS: u32 = 3;
/// Timeouts after the last byte of a possible answer within which the line must fall silent. Otherwise the
/// call fails, and the next one continues to wait.
const MAX_SETTLING: u64 = 2;
/// Interval in ns at which a waiting call checks for a stop.
const LOOK_NS: u64 = 2_000_000;

/// Why an instruction has no result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum BusError {
    /// The instruction cannot be encoded.
    #[error(transparent)]
    Request(#[from] RequestError),
    /// Another process of ours has the port.
    #[error("another process has the port: it must end first")]
    Busy,
    /// The port is gone, or the system refuses it.
    #[error(transparent)]
    Port(#[from] Errno),
    /// No answer, or an incomplete one.
    #[error("id {id} did not answer within {timeout_ms} ms")]
    Silent {
        /// Servo; of several, the first.
        id: u8,
        /// Timeout in ms.
        timeout_ms: u64,
    },
    /// The line did not fall silent before an instruction, or until the deadline of its answer: two
    /// controllers, or an adapter that echoes.
    #[error("bytes that nobody asked for arrive without end: the bus must have one controller, and no echo")]
    Noise,
    /// An invalid packet arrived.
    #[error(transparent)]
    Frame(#[from] FrameError),
    /// Another servo answered.
    #[error("id {seen} answered: must be id {allowed}")]
    Id {
        /// Id that answered.
        seen: u8,
        /// Id that was asked.
        allowed: u8,
    },
    /// The number of bytes differs from that of the answer.
    #[error("{seen} bytes of id {id}: must be {allowed}")]
    Length {
        /// Servo.
        id: u8,
        /// Bytes received.
        seen: usize,
        /// Bytes of a valid answer.
        allowed: usize,
    },
    /// The servo refuses the instruction.
    #[error("id {id}: {error}")]
    Refused {
        /// Servo.
        id: u8,
        /// Error byte.
        error: StatusError,
    },
    /// A read of several servos failed.
    #[error(transparent)]
    SyncRead(#[from] SyncReadError),
    /// Another thread sends a stop: the call did not wait for its answer, or was not sent.
    #[error("a stop cut this call off")]
    Stopped,
    /// One of the threads has closed the bus.
    #[error("is closed")]
    Closed,
}

/// Servos on one serial port, of which this is the only controller.
///
/// At the start and after a failure, waits until the line has been silent for the timeout. A late answer is
/// then not mistaken for that of the next instruction, unless it is later than two timeouts.
#[derive(Debug)]
pub struct Bus {
    port: SerialPort,
    baud: u32,
    timeout_ns: u64,
    packet: Packet,
    parser: StatusParser,
    unsettled: bool,
    /// Time in ns until which the line carries bytes already sent.
    busy_until_ns: u64,
    /// End of the last requested answer in ns, unless it is known to be over.
    answer_until_ns: u64,
    /// Bytes still accepted after the deadline, for an answer that arrived while this thread was not running.
    late: usize,
    stops: Arc<Stops>,
}

impl Bus {
    /// Open a port at a rate in bit/s. An answer may take `timeout_ns` longer than its bytes take on the
    /// wire.
    pub fn open(path: &Path, baud: u32, timeout_ns: u64) -> Result<Self, BusError> {
        Ok(Self {
            port: SerialPort::open(path, baud).map_err(|error| match error {
                Errno::WOULDBLOCK => BusError::Busy,
                other => other.into(),
            })?,
            baud,
            timeout_ns,
            packet: Packet::default(),
            parser: StatusParser::default(),
            // The previous user of the port may have requested an answer.
            unsettled: true,
            busy_until_ns: 0,
            answer_until_ns: 0,
            late: 0,
            stops: Arc::default(),
        })
    }

    /// Set the stops for which calls end early.
    pub(super) fn end_for(&mut self, stops: Arc<Stops>) {
        self.stops = stops;
    }

    /// Read model number and firmware version of a servo.
    pub fn ping(&mut self, id: u8) -> Result<(u16, u8), BusError> {
        let mut answer = [0; 3];
        self.ask(&Instruction::Ping { id }, id, &mut answer)?;
        Ok((u16::from_le_bytes([answer[0], answer[1]]), answer[2]))
    }

    /// Read bytes from an address on; return true if the servo has a hardware error.
    pub fn read(&mut self, id: u8, address: u16, bytes: &mut [u8]) -> Result<bool, BusError> {
        let length = u16::try_from(bytes.len()).map_err(|_| RequestError::TooLong { seen: bytes.len() })?;
        self.ask(&Instruction::Read { id, address, length }, id, bytes)
    }

    /// Write bytes from an address on; return true if the servo has a hardware error. [`BROADCAST`] is not
    /// answered.
    pub fn write(&mut self, id: u8, address: u16, data: &[u8]) -> Result<bool, BusError> {
        self.ask(&Instruction::Write { id, address, data }, id, &mut [])
    }

    /// Restarts a servo, which is then silent for a while. [`BROADCAST`] is not answered.
    pub fn reboot(&mut self, id: u8) -> Result<bool, BusError> {
        self.ask(&Instruction::Reboot { id }, id, &mut [])
    }

    /// Read several servos; [`SyncRead::replies`] then has the values of all, or none.
    pub fn sync_read(&mut self, read: &mut SyncRead) -> Result<(), BusError> {
        // Discards previous values, even if this call fails.
        read.begin();
        self.settle()?;
        let result = self.exchange(read);
        self.unsettled = result.is_err();
        result
    }

    fn exchange(&mut self, read: &mut SyncRead) -> Result<(), BusError> {
        let expected = read.answer_size();
        self.discard()?;
        let request = read.begin();
        let deadline_ns = self.begin(request.len(), expected);
        self.port.send(request, deadline_ns)?;
        let mut buffer = [0; 256];
        loop {
            let count = self.receive(&mut buffer, deadline_ns)?;
            if count == 0 {
                let id = read.unanswered().first().copied().unwrap_or(BROADCAST);
                return Err(self.silent(id));
            }
            if read.receive(&buffer[..count])? == Progress::Complete {
                self.answer_until_ns = 0;
                return Ok(());
            }
        }
    }

    /// Write the same addresses of several servos; none answers. First waits until a failed answer is over:
    /// as long as its bytes take, at most the timeout.
    pub fn sync_write(&mut self, address: u16, length: u16, ids: &[u8], data: &[u8]) -> Result<(), BusError> {
        self.packet.encode(&Instruction::SyncWrite { address, length, ids, data })?;
        self.let_by()?;
        Ok(self.send_packet()?)
    }

    /// Same as [`Self::sync_write`], but waits neither for an answer nor for silence. It is sent three times,
    /// spaced by the answer that it may have collided with. Fails if none could be sent.
    pub fn stop(&mut self, address: u16, length: u16, ids: &[u8], data: &[u8]) -> Result<(), BusError> {
        self.packet.encode(&Instruction::SyncWrite { address, length, ids, data })?;
        let gap_ns = self.answer_until_ns.saturating_sub(now_ns()).min(self.timeout_ns);
        let mut result = Err(Errno::TIMEDOUT);
        for index in 0..STOPS {
            if index > 0 && gap_ns > 0 {
                sleep_ns(gap_ns);
            }
            result = result.or(self.send_packet());
        }
        Ok(result?)
    }

    fn send_packet(&mut self) -> Result<(), Errno> {
        let length = self.packet.bytes().len();
        let deadline_ns = self.begin(length, 0);
        self.port.send(self.packet.bytes(), deadline_ns)
    }

    /// Send one instruction and receives the answer of one servo.
    fn ask(&mut self, instruction: &Instruction<'_>, id: u8, answer: &mut [u8]) -> Result<bool, BusError> {
        self.packet.encode(instruction)?;
        if id == BROADCAST {
            return if answer.is_empty() {
                self.let_by()?;
                self.send_packet()?;
                Ok(false)
            } else {
                Err(RequestError::Id { seen: id }.into())
            };
        }
        self.settle()?;
        let result = self.answered(id, answer);
        // A refusal is an answer too.
        self.unsettled = !matches!(result, Ok(_) | Err(BusError::Refused { .. }));
        result
    }

    fn answered(&mut self, id: u8, answer: &mut [u8]) -> Result<bool, BusError> {
        self.parser.reset();
        self.discard()?;
        let deadline_ns = self.begin(self.packet.bytes().len(), STATUS_OVERHEAD + 2 * answer.len());
        self.port.send(self.packet.bytes(), deadline_ns)?;
        let silent = self.silent(id);
        let mut buffer = [0; 256];
        loop {
            let count = self.receive(&mut buffer, deadline_ns)?;
            if count == 0 {
                return Err(silent);
            }
            let mut rest = &buffer[..count];
            let Some(received) = self.parser.next(&mut rest) else { continue };
            let status = match received? {
                Received::Status(status) => status,
                Received::Fast(_) => return Err(BusError::Id { seen: BROADCAST, allowed: id }),
            };
            if status.id != id {
                return Err(BusError::Id { seen: status.id, allowed: id });
            }
            self.answer_until_ns = 0;
            if status.error.refusal().is_some() {
                return Err(BusError::Refused { id, error: status.error });
            }
            if status.parameters.len() != answer.len() {
                return Err(BusError::Length { id, seen: status.parameters.len(), allowed: answer.len() });
            }
            answer.copy_from_slice(status.parameters);
            return Ok(status.error.alert());
        }
    }

    /// After a failure, waits until the line is silent.
    fn settle(&mut self) -> Result<(), BusError> {
        if !self.unsettled {
            return Ok(());
        }
        let mut buffer = [0; 256];
        let given_up_ns = now_ns().max(self.answer_until_ns) + MAX_SETTLING * self.timeout_ns;
        self.late = buffer.len();
        while self.receive(&mut buffer, now_ns() + self.timeout_ns)? > 0 {
            if now_ns() > given_up_ns {
                return Err(BusError::Noise);
            }
        }
        self.unsettled = false;
        Ok(())
    }

    fn discard(&self) -> Result<(), BusError> {
        if self.port.discard()? { Ok(()) } else { Err(BusError::Noise) }
    }

    /// Receives bytes before a deadline; 0 if none arrive. After the deadline it accepts at most the size of
    /// an answer; more is noise.
    fn receive(&mut self, buffer: &mut [u8], deadline_ns: u64) -> Result<usize, BusError> {
        loop {
            let now_ns = now_ns();
            if self.stops.cut(now_ns) {
                return Err(BusError::Stopped);
            }
            let left_ns = deadline_ns.saturating_sub(now_ns);
            if left_ns == 0 && self.late == 0 {
                return Err(BusError::Noise);
            }
            let count = self.port.receive(buffer, left_ns.min(LOOK_NS))?;
            if left_ns == 0 {
                self.late = self.late.saturating_sub(count);
            }
            if count > 0 || left_ns == 0 {
                return Ok(count);
            }
        }
    }

    /// Accounts for bytes sent now and for their answer; returns the deadline of both. Bytes sent earlier and
    /// still on the line go first.
    fn begin(&mut self, sent: usize, answered: usize) -> u64 {
        self.busy_until_ns = self.busy_until_ns.max(now_ns()) + self.wire_ns(sent);
        let end_ns = self.busy_until_ns + self.wire_ns(answered);
        self.late = answered;
        if answered > 0 {
            self.answer_until_ns = end_ns;
        }
        end_ns + self.timeout_ns
    }

    /// Waits for the end of an answer that failed before its last byte.
    fn let_by(&mut self) -> Result<(), BusError> {
        let begin_ns = now_ns();
        let until_ns = self.answer_until_ns.min(begin_ns + self.timeout_ns);
        let mut now = begin_ns;
        while now < until_ns {
            if self.stops.cut(now) {
                return Err(BusError::Stopped);
            }
            sleep_ns((until_ns - now).min(LOOK_NS));
            now = now_ns();
        }
        self.answer_until_ns = 0;
        Ok(())
    }

    fn wire_ns(&self, bytes: usize) -> u64 {
        BITS_PER_BYTE * SECOND_NS * bytes as u64 / u64::from(self.baud.max(1))
    }

    fn silent(&self, id: u8) -> BusError {
        BusError::Silent { id, timeout_ms: self.timeout_ns / 1_000_000 }
    }
}
