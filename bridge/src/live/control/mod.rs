//! Control socket of a live side, for commands from other programs.
//!
//! It is separate from telemetry, whose readers must not command. Its thread needs no interpreter, so a stop acts
//! whatever Python does. The loop sees ordinary commands. Lines of JSON, see docs/console.md.

mod aiming;
mod hold;
mod request;

use std::{
    io::{self, Read},
    os::{fd::OwnedFd, unix::net::UnixStream},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::{Errno, fcntl_dupfd_cloexec},
    net::{SendFlags, send},
    time::{ClockId, clock_gettime},
};

use haptether_master::Aim;
use haptether_slave::Push;

use self::{
    aiming::Aiming,
    hold::{Beat, Held, Hold},
    request::{Answer, Request, Status},
};
use super::{
    handle::{CommandError, ControlPort, Ineffective},
    own_thread::OwnThread,
};
use crate::{
    command::OperatorCommand,
    coupling::CouplingKind,
    live_socket::LiveSocket,
    port::MAX_AXES,
    wire::{Padded, Role},
};

/// Maximum number of connections. A further one closes the idlest, so that none blocks a stop.
const MAX_CONNECTIONS: usize = 32;
/// Maximum number accepted before open ones are served.
const MAX_ACCEPTED: usize = 8;
/// Time in us for which a new connection counts as busy, awaiting its first request.
const NEW_US: u64 = 100_000;
/// Bytes of a request, without its end.
const MAX_REQUEST: usize = 512;
/// Requests of a connection answered before others are served.
const MAX_AT_ONCE: usize = 8;
/// Interval of checks whether the loop is over.
const LOOK_EVERY: Timespec = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };
const AT_ONCE: Timespec = Timespec { tv_sec: 0, tv_nsec: 0 };
/// Maximum age of the token of a request in us.
const MAX_TOKEN_US: u64 = 400_000;
/// Maximum wait of a stop's answer for the loop to be at rest.
const REST: Duration = Duration::from_millis(300);

/// A listening control socket. Clients wait until there is a loop.
pub struct ControlSocket {
    socket: LiveSocket,
    path: PathBuf,
}

impl ControlSocket {
    /// Listens at `path`, for the owner only. Replaces a stale socket, and refuses anything else.
    pub fn listen(path: &Path) -> io::Result<Self> {
        let socket = LiveSocket::listen(path, "another run is controlled there")?;
        Ok(Self { socket, path: path.to_owned() })
    }

    /// Serve the loop until it is over. A driver also takes acknowledgements, by
    /// [`super::LiveHandle::take_acknowledgement`].
    pub fn serve(self, role: Role, port: ControlPort, has_driver: bool) -> io::Result<Control> {
        let is_over = Arc::<AtomicBool>::default();
        let theirs = Arc::clone(&is_over);
        let Self { socket, path } = self;
        let spare = Some(spare(&socket)?);
        let thread = thread::Builder::new().name("haptether-control".into()).spawn(move || {
            let (hold, aiming, connected) = (Hold::default(), Aiming::default(), Vec::new());
            let server = Server { socket, spare, role, port, has_driver, hold, aiming, connected, next: 0 };
            server.serve(&theirs);
        })?;
        Ok(Control { thread: OwnThread::new(thread), is_over, path })
    }
}

/// Thread that serves a control socket; dropping this ends it.
#[derive(Debug)]
pub struct Control {
    thread: OwnThread<()>,
    is_over: Arc<AtomicBool>,
    path: PathBuf,
}

impl Control {
    /// Path of the socket.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Control {
    fn drop(&mut self) {
        self.is_over.store(true, Ordering::Relaxed);
        let _ = self.thread.join();
    }
}

/// Time since boot in us, including suspends, so that messages from before one are old. Exact in a browser's numbers
/// for centuries.
fn now_us() -> u64 {
    let now = clock_gettime(ClockId::Boottime);
    #[allow(clippy::cast_sign_loss)] // it starts at boot
    let (seconds, nanoseconds) = (now.tv_sec as u64, now.tv_nsec as u64);
    seconds * 1_000_000 + nanoseconds / 1000
}

fn is_fresh(token: u64) -> bool {
    now_us().checked_sub(token).is_some_and(|age_us| age_us <= MAX_TOKEN_US)
}

/// Duplicates a descriptor, to be freed for a connection when none is left.
fn spare(socket: &LiveSocket) -> io::Result<OwnedFd> {
    Ok(fcntl_dupfd_cloexec(socket, 0)?)
}

struct Connection {
    number: u64,
    stream: UnixStream,
    received: Vec<u8>,
    /// Time of the last request in us, or until which the first is awaited.
    active_us: u64,
}

impl Connection {
    /// Send a line. Returns whether all was taken at once, as for a reading client.
    fn send(&self, line: &[u8]) -> bool {
        loop {
            match send(&self.stream, line, SendFlags::NOSIGNAL | SendFlags::DONTWAIT) {
                Ok(taken) => return taken == line.len(),
                Err(Errno::INTR) => {}
                Err(_) => return false,
            }
        }
    }

    /// Receives pending bytes. Returns whether the connection is still open.
    fn receive(&mut self) -> bool {
        // A too fast client waits.
        if self.received.len() > MAX_REQUEST {
            return true;
        }
        let mut bytes = [0; MAX_REQUEST * MAX_AT_ONCE];
        match self.stream.read(&mut bytes) {
            Ok(0) => false,
            Ok(count) => {
                self.received.extend_from_slice(&bytes[..count]);
                true
            }
            Err(error) => matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted),
        }
    }

    /// Next complete line; an error if longer than a request may be.
    fn line(&mut self) -> Result<Option<Vec<u8>>, String> {
        let end = self.received.iter().position(|byte| *byte == b'\n');
        if end.unwrap_or(self.received.len()) > MAX_REQUEST {
            return Err(format!("a request of more than {MAX_REQUEST} bytes"));
        }
        Ok(end.map(|end| {
            let mut line: Vec<u8> = self.received.drain(..=end).collect();
            line.pop();
            line
        }))
    }
}

struct Server {
    socket: LiveSocket,
    /// `None` while a connection uses it.
    spare: Option<OwnedFd>,
    role: Role,
    port: ControlPort,
    has_driver: bool,
    hold: Hold,
    aiming: Aiming,
    connected: Vec<Connection>,
    next: u64,
}

impl Server {
    fn serve(mut self, is_over: &AtomicBool) {
        // A stop is answered before this ends: it waits for the loop to be at rest.
        while !is_over.load(Ordering::Relaxed) && !self.port.handle().is_at_rest() {
            self.wait();
            self.accept();
            let connected = std::mem::take(&mut self.connected);
            for mut connection in connected {
                if self.serve_one(&mut connection) {
                    self.connected.push(connection);
                } else {
                    self.end(connection.number);
                }
            }
            // A closed connection may have used it.
            self.spare = self.spare.take().or_else(|| spare(&self.socket).ok());
        }
    }

    /// Waits for input, a new connection or the next check.
    fn wait(&self) {
        if self.connected.iter().any(|connection| connection.received.contains(&b'\n')) {
            return;
        }
        let mut seen = vec![PollFd::new(&self.socket, PollFlags::IN)];
        seen.extend(self.connected.iter().map(|connection| PollFd::new(&connection.stream, PollFlags::IN)));
        if poll(&mut seen, Some(&LOOK_EVERY)).is_err() {
            thread::sleep(Duration::from_millis(1));
        }
    }

    /// Accept connections. Closes the idlest if too many, or without a free descriptor.
    fn accept(&mut self) {
        for _ in 0..MAX_ACCEPTED {
            // Without a descriptor `accept` fails even if nobody waits, and would close a connection in vain.
            let mut waiting = [PollFd::new(&self.socket, PollFlags::IN)];
            if poll(&mut waiting, Some(&AT_ONCE)) != Ok(1) {
                return;
            }
            match self.socket.accept() {
                Ok(Some(stream)) => {
                    if self.connected.len() == MAX_CONNECTIONS {
                        self.displace();
                    }
                    let active_us = now_us() + NEW_US;
                    let connection =
                        Connection { number: self.next, stream, received: Vec::new(), active_us };
                    self.connected.push(connection);
                    self.next += 1;
                }
                Ok(None) => return,
                Err(_) if self.spare.take().is_some() || self.displace() => {}
                // Other parts of this process hold all descriptors.
                Err(_) => return thread::sleep(Duration::from_millis(1)),
            }
        }
    }

    /// Close the idlest connection with a reason, after answering its request. False without any.
    fn displace(&mut self) -> bool {
        let idlest = (0..self.connected.len()).min_by_key(|at| self.connected[*at].active_us);
        let Some(mut idlest) = idlest.map(|at| self.connected.swap_remove(at)) else { return false };
        if self.serve_one(&mut idlest) {
            let text =
                format!("another program has connected: {MAX_CONNECTIONS} may, and this was the idlest");
            idlest.send(&Answer { text, ..Answer::default() }.line());
        }
        self.end(idlest.number);
        true
    }

    /// End what connection `from` held or aimed.
    fn end(&mut self, from: u64) {
        self.hold.end(from);
        if self.aiming.end(from) {
            // With a full queue the hand opens by itself when the last aim expires.
            let _ = self.port.command(OperatorCommand::Aim(Aim::open()));
        }
    }

    /// Answer requests. Returns whether the connection stays.
    fn serve_one(&mut self, connection: &mut Connection) -> bool {
        let is_there = connection.receive();
        for _ in 0..MAX_AT_ONCE {
            let line = match connection.line() {
                Ok(Some(line)) => line,
                Ok(None) => break,
                Err(text) => {
                    connection.send(&Answer { text, ..Answer::default() }.line());
                    return false;
                }
            };
            match Request::of(&line) {
                Ok(request) => {
                    connection.active_us = now_us();
                    let answer = self.answer(connection.number, request);
                    if !connection.send(&answer.line()) {
                        return false;
                    }
                }
                Err(text) => {
                    connection.send(&Answer { text, ..Answer::default() }.line());
                    return false;
                }
            }
        }
        is_there
    }

    fn answer(&mut self, from: u64, request: Request) -> Answer {
        let answer = Answer { request: request.name(), done: true, ..Answer::default() };
        let refused = |text: &str| Answer { done: false, text: text.into(), ..answer.clone() };
        match request {
            Request::Stop {} => Answer { text: self.stop().into(), status: Some(self.status()), ..answer },
            Request::Status {} => Answer { token: Some(now_us()), status: Some(self.status()), ..answer },
            Request::LetGo {} => {
                self.hold.end(from);
                Answer { text: "let go".into(), ..answer }
            }
            _ if self.port.handle().is_stopped() => refused("the run is being stopped"),
            Request::Hold { .. } | Request::Release {} if self.role != Role::Master => {
                refused("the clutch is at the master: send it there")
            }
            Request::Hold { held_ms, token } => self.beat(from, held_ms, token, answer),
            Request::Release {} => self.command(OperatorCommand::Release, "the clutch is released", answer),
            Request::Acknowledge { token } if is_fresh(token) => self.acknowledge(answer),
            Request::ForceScale { .. } | Request::TorqueScale { .. } if self.role != Role::Master => {
                refused("the scale of the force is at the master: send it there")
            }
            Request::PositionScale { .. } | Request::RotationScale { .. } if self.role != Role::Slave => {
                refused("the scale of the motion is at the slave: send it there")
            }
            Request::Coupling { .. } if self.role != Role::Master => {
                refused("the coupling is switched at the master: send it there")
            }
            Request::Coupling { kind, token } if is_fresh(token) => {
                let Some(found) = CouplingKind::ALL.iter().find(|one| one.name() == kind) else {
                    return refused(&format!("coupling {kind:?}: there is none of this name"));
                };
                let done = format!("{kind} after the next press; the clutch is released");
                self.command(OperatorCommand::Coupling(*found), &done, answer)
            }
            Request::ForceScale { scale, token } if is_fresh(token) => {
                self.scale(OperatorCommand::ForceScale(scale), scale, answer)
            }
            Request::PositionScale { scale, token } if is_fresh(token) => {
                self.scale(OperatorCommand::PositionScale(scale), scale, answer)
            }
            Request::TorqueScale { scale, token } if is_fresh(token) => {
                self.scale(OperatorCommand::TorqueScale(scale), scale, answer)
            }
            Request::RotationScale { scale, token } if is_fresh(token) => {
                self.scale(OperatorCommand::RotationScale(scale), scale, answer)
            }
            Request::Aim { .. } if self.role != Role::Master => {
                refused("the hand is at the master: send it there")
            }
            Request::Push { .. } if self.role != Role::Slave => {
                refused("the tool is at the slave: send it there")
            }
            Request::Aim { target, over_s, stiffness, damping, strength_n, token } if is_fresh(token) => {
                match self.padded("target", &target) {
                    Ok(target) => {
                        self.aim(from, Aim { target, over_s, stiffness, damping, strength_n }, answer)
                    }
                    Err(text) => refused(&text),
                }
            }
            Request::Push { force, duration_s, token } if is_fresh(token) => {
                match self.padded("force", &force) {
                    Ok(force_n) => self.push(Push { force_n, duration_s }, answer),
                    Err(text) => refused(&text),
                }
            }
            Request::Acknowledge { .. }
            | Request::Coupling { .. }
            | Request::Aim { .. }
            | Request::Push { .. }
            | Request::ForceScale { .. }
            | Request::PositionScale { .. }
            | Request::TorqueScale { .. }
            | Request::RotationScale { .. } => {
                refused("it came too late, or without a status before it: once more")
            }
        }
    }

    /// The driver takes the acknowledgement; the loop alone would clear a persisting fault.
    fn acknowledge(&mut self, answer: Answer) -> Answer {
        if self.has_driver {
            self.port.handle().acknowledge_device();
            return Answer { text: "acknowledged, to the device as well".into(), ..answer };
        }
        self.command(OperatorCommand::Acknowledge, "what was wrong counts as mended", answer)
    }

    /// End the loop and wait briefly for rest; no later request needs this thread.
    fn stop(&mut self) -> &'static str {
        self.port.handle().stop();
        let end = Instant::now() + REST;
        while !self.port.handle().is_at_rest() {
            if Instant::now() >= end {
                return "stopped, but it is not at rest yet: its driver has not returned";
            }
            thread::sleep(Duration::from_millis(1));
        }
        "stopped: no force, no motion"
    }

    fn beat(&mut self, from: u64, held_ms: u32, token: Option<u64>, answer: Answer) -> Answer {
        let held_ns = u64::from(held_ms) * 1_000_000;
        let now_ns = now_us() * 1000;
        let token = token.map(|token| token.saturating_mul(1000));
        match self.hold.beat(Beat { from, now_ns, held_ns, token }) {
            Held::Goes(next) => Answer {
                text: "held".into(),
                token: Some(next.div_ceil(1000)),
                pressed: Some(false),
                ..answer
            },
            Held::Pressed => {
                self.port.handle().press_clutch();
                Answer { text: "the clutch is pressed".into(), pressed: Some(true), ..answer }
            }
            Held::Void(text) => Answer { done: false, text: text.into(), pressed: Some(false), ..answer },
        }
    }

    /// One value per axis; an error at a side without a hand to aim.
    fn padded(&self, name: &str, values: &[f64]) -> Result<Padded, String> {
        let axes = self.port.handle().aimed_axes().ok_or_else(|| CommandError::NotAimed.to_string())?;
        if values.len() != axes {
            return Err(format!("{name}: {} values, must be {axes}, one per axis", values.len()));
        }
        let mut padded = Padded::zeros();
        padded.rows_mut(0, axes).copy_from_slice(values);
        Ok(padded)
    }

    fn aim(&mut self, from: u64, aim: Aim<MAX_AXES>, answer: Answer) -> Answer {
        let now_us = now_us();
        if !self.aiming.may(from, now_us) {
            let text = "another page or program aims this hand: it must stop for 0.4 s first".into();
            return Answer { done: false, text, ..answer };
        }
        let answer = self.command(OperatorCommand::Aim(aim), "aimed", answer);
        if !answer.done {
            return answer;
        }
        self.aiming.aimed(from, now_us);
        Answer { token: Some(now_us), acts_at: Some(self.port.handle().next_period()), ..answer }
    }

    fn push(&mut self, push: Push<MAX_AXES>, answer: Answer) -> Answer {
        if !self.port.handle().state().is_coupled() {
            let text = "the sides are not engaged: a push begins after the engagement".into();
            return Answer { done: false, text, ..answer };
        }
        let answer = self.command(OperatorCommand::Push(push), "pushed", answer);
        let acts_at = answer.done.then(|| self.port.handle().next_period());
        Answer { acts_at, ..answer }
    }

    fn scale(&mut self, command: OperatorCommand, scale: f64, answer: Answer) -> Answer {
        self.command(command, &format!("the scale goes to {scale}"), answer)
    }

    fn command(&mut self, command: OperatorCommand, done: &str, answer: Answer) -> Answer {
        match self.port.command(command) {
            Ok(()) => Answer { text: done.into(), ..answer },
            Err(error) => Answer { done: false, text: error.to_string(), ..answer },
        }
    }

    fn status(&self) -> Status {
        let handle = self.port.handle();
        let (ineffective_presses, why) = handle.ineffective_presses();
        Status {
            side: if self.role == Role::Master { "master" } else { "slave" },
            state: handle.state().name(),
            ticks: handle.ticks(),
            is_stopped: handle.is_stopped(),
            is_at_rest: handle.is_at_rest(),
            ineffective_presses,
            ineffective: why.and_then(Ineffective::text),
        }
    }
}
