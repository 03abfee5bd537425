//! Bus on a Unix socket whose peer floods or answers.
#![allow(clippy::unwrap_used)] // permitted in a test

use std::{
    env, fs,
    io::{ErrorKind, Read, Write},
    os::unix::net::UnixListener,
    path::PathBuf,
    process,
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use haptether_dynamixel::{Bus, BusError, Instruction, Packet, SharedBus, SyncRead};

const BAUD: u32 = 4_000_000;
const TIMEOUT_NS: u64 = 20_000_000;
/// Limit for a call that ends within some timeouts.
const PATIENCE: Duration = Duration::from_secs(2);
/// Maximum duration of a flood, if a test fails.
const FLOODED: Duration = Duration::from_secs(30);
/// Timeout of calls without an answer.
const LONG: Duration = Duration::from_secs(4);
/// Source: ROBOTIS e-Manual, "Ping", the answer of id 1.
const PONG: [u8; 14] = [0xFF, 0xFF, 0xFD, 0x00, 0x01, 0x07, 0x00, 0x55, 0x00, 0x06, 0x04, 0x26, 0x65, 0x5D];

#[derive(Clone, Copy, PartialEq, Eq)]
enum Peer {
    /// Floods from the start.
    Floods,
    /// Floods after the first request.
    FloodsWhenAsked,
    /// Answers the first instruction as a ping, then floods.
    FloodsAfterAnAnswer,
    /// Answers the first instructions as pings, then is silent.
    Answers(usize),
}

struct Line {
    path: PathBuf,
    over: Arc<AtomicBool>,
    /// Set once the socket buffer is full.
    full: Arc<AtomicBool>,
    heard: Arc<Mutex<Vec<u8>>>,
    thread: Option<JoinHandle<()>>,
}

impl Line {
    fn new(name: &str, peer: Peer) -> Self {
        let path = env::temp_dir().join(format!("haptether-{}-{name}", process::id()));
        let _ = fs::remove_file(&path);
        let listener = UnixListener::bind(&path).unwrap();
        let over = Arc::new(AtomicBool::new(false));
        let full = Arc::new(AtomicBool::new(false));
        let heard = Arc::new(Mutex::new(Vec::new()));
        let of_thread = (Arc::clone(&over), Arc::clone(&full), Arc::clone(&heard));
        let thread =
            Some(thread::spawn(move || serve(&listener, peer, &of_thread.0, &of_thread.1, &of_thread.2)));
        Self { path, over, full, heard, thread }
    }

    fn bus(&self) -> Bus {
        Bus::open(&self.path, BAUD, TIMEOUT_NS).unwrap()
    }

    fn shared(&self, timeout: Duration) -> SharedBus {
        let timeout_ns = u64::try_from(timeout.as_nanos()).unwrap();
        SharedBus::new(Bus::open(&self.path, BAUD, timeout_ns).unwrap())
    }

    fn heard(&self) -> usize {
        self.heard.lock().unwrap().len()
    }

    /// Waits until the packet has arrived `times` times in a row, complete.
    fn hears(&self, packet: &[u8], times: usize) {
        let expected = packet.repeat(times);
        ended(|| {
            while !self.heard.lock().unwrap().ends_with(&expected) {
                assert!(!self.over.load(Ordering::Relaxed));
                thread::yield_now();
            }
        });
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        self.thread.take().unwrap().join().unwrap();
        let _ = fs::remove_file(&self.path);
    }
}

fn serve(listener: &UnixListener, peer: Peer, over: &AtomicBool, full: &AtomicBool, heard: &Mutex<Vec<u8>>) {
    let (mut stream, _) = listener.accept().unwrap();
    stream.set_nonblocking(true).unwrap();
    let end = Instant::now() + FLOODED;
    let (mut floods, mut answered, mut buffer) = (peer == Peer::Floods, 0, [0; 1024]);
    while !over.load(Ordering::Relaxed) && Instant::now() < end {
        match stream.read(&mut buffer) {
            Ok(0) => return,
            Ok(count) => {
                heard.lock().unwrap().extend(&buffer[..count]);
                let answers = match peer {
                    Peer::FloodsAfterAnAnswer => 1,
                    Peer::Answers(first) => first,
                    Peer::Floods | Peer::FloodsWhenAsked => 0,
                };
                if answered < answers {
                    stream.write_all(&PONG).unwrap();
                    answered += 1;
                }
                floods |= !matches!(peer, Peer::Answers(_));
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            // The bus is closed.
            Err(_) => return,
        }
        if !floods {
            thread::sleep(Duration::from_micros(100));
        } else if (0..32).any(|_| stream.write(&[0x55; 4096]).is_err()) {
            // The flood contains no header, and the buffer is full.
            full.store(true, Ordering::Relaxed);
        }
    }
}

/// Run a call that must end in time.
fn ended<T>(call: impl FnOnce() -> T) -> T {
    let begin = Instant::now();
    let result = call();
    assert!(begin.elapsed() < PATIENCE, "{:?}", begin.elapsed());
    result
}

#[test]
fn flooded_line_fails_before_a_request_is_sent() {
    // On a busy machine the flood may have a gap, in which the request is sent: retry.
    let is_given_up = (0..20).any(|_| {
        let line = Line::new("floods", Peer::Floods);
        let mut bus = line.bus();
        let begin = Instant::now();
        let error = ended(|| bus.ping(1)).unwrap_err();
        let took = begin.elapsed();
        assert!(error != BusError::Noise || line.heard() == 0);
        // Calls that wait for nothing are sent.
        ended(|| bus.sync_write(102, 2, &[1], &[0, 0])).unwrap();
        ended(|| bus.stop(64, 1, &[1], &[0])).unwrap();
        // Two timeouts.
        error == BusError::Noise && took < Duration::from_nanos(5 * TIMEOUT_NS)
    });
    assert!(is_given_up);
}

/// Test if a call on a line that floods after a request reports noise. On a busy machine the flood may have
/// a gap, in which the call times out: retry.
fn reports_noise(name: &str, call: impl Fn(&mut Bus) -> Option<BusError>) -> bool {
    (0..20).any(|_| {
        let line = Line::new(name, Peer::FloodsWhenAsked);
        let mut bus = line.bus();
        let error = ended(|| call(&mut bus)).unwrap();
        assert!(line.heard() > 0);
        assert!(matches!(error, BusError::Noise | BusError::Silent { .. }), "{error}");
        error == BusError::Noise
    })
}

#[test]
fn a_call_ends_at_its_deadline_during_a_flood() {
    assert!(reports_noise("ping", |bus| bus.ping(1).err()));
}

#[test]
fn a_read_of_several_ends_at_its_deadline_during_a_flood() {
    for fast in [true, false] {
        assert!(reports_noise("several", |bus| {
            let mut read = SyncRead::new(fast, 126, 10, &[1, 2, 3]).unwrap();
            let error = bus.sync_read(&mut read).err();
            assert!(read.replies().is_none());
            error
        }));
    }
}

#[test]
fn discarding_received_bytes_ends_during_a_flood() {
    let line = Line::new("answers", Peer::FloodsAfterAnAnswer);
    let mut bus = line.bus();
    assert_eq!(ended(|| bus.ping(1)), Ok((1030, 38)));
    let asked = line.heard();
    // The bus considers the line settled, but the flood has begun.
    ended(|| {
        while !line.full.load(Ordering::Relaxed) {
            thread::yield_now();
        }
    });
    assert_eq!(ended(|| bus.ping(1)), Err(BusError::Noise));
    assert_eq!(line.heard(), asked);
}

/// Write 0 to Torque Enable of two servos.
fn stop(bus: &SharedBus) -> Result<(), BusError> {
    bus.stop(64, 1, &[1, 2], &[0, 0])
}

fn stop_packet() -> Vec<u8> {
    let mut packet = Packet::default();
    packet.encode(&Instruction::SyncWrite { address: 64, length: 1, ids: &[1, 2], data: &[0, 0] }).unwrap();
    packet.bytes().to_vec()
}

#[test]
fn a_stop_cuts_off_a_call_that_waits_for_silence() {
    for (peer, name) in [(Peer::Answers(0), "settling"), (Peer::Floods, "flooded")] {
        let line = Line::new(name, peer);
        let bus = line.shared(LONG);
        thread::scope(|scope| {
            let call = scope.spawn(|| bus.call(|bus| bus.ping(1)));
            thread::sleep(Duration::from_millis(50));
            assert!(!call.is_finished());
            ended(|| stop(&bus)).unwrap();
            assert_eq!(ended(|| call.join().unwrap()), Err(BusError::Stopped));
        });
        line.hears(&stop_packet(), 3);
    }
}

#[test]
fn a_stop_cuts_off_a_call_that_waits_for_an_answer() {
    let line = Line::new("asking", Peer::Answers(1));
    let bus = line.shared(LONG);
    // The line has then been silent for the timeout.
    assert!(bus.call(|bus| bus.ping(1)).is_ok());
    let asked = line.heard();
    thread::scope(|scope| {
        let call = scope.spawn(|| bus.call(|bus| bus.ping(1)));
        ended(|| {
            while line.heard() == asked {
                thread::yield_now();
            }
        });
        assert!(!call.is_finished());
        ended(|| stop(&bus)).unwrap();
        assert_eq!(ended(|| call.join().unwrap()), Err(BusError::Stopped));
    });
    line.hears(&stop_packet(), 3);
}

#[test]
fn a_stop_precedes_all_waiting_calls() {
    let line = Line::new("crowded", Peer::Answers(0));
    let bus = line.shared(LONG);
    let over = AtomicBool::new(false);
    let mut stops = 0;
    thread::scope(|scope| {
        let calls = [(); 4].map(|()| {
            scope.spawn(|| {
                while !over.load(Ordering::Relaxed) {
                    // Each call waits for silence.
                    assert_eq!(bus.call(|bus| bus.ping(1)), Err(BusError::Stopped));
                }
            })
        });
        // Each call still waiting at the end gets a stop.
        while !calls.iter().all(thread::ScopedJoinHandle::is_finished) {
            over.store(stops >= 5, Ordering::Relaxed);
            thread::sleep(Duration::from_millis(20));
            ended(|| stop(&bus)).unwrap();
            stops += 1;
        }
    });
    line.hears(&stop_packet(), 3 * stops);
}

#[test]
fn calls_of_several_threads_are_one_after_the_other() {
    let line = Line::new("threads", Peer::Answers(usize::MAX));
    let bus = line.shared(Duration::from_millis(500));
    thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                for _ in 0..50 {
                    assert_eq!(bus.call(|bus| bus.ping(1)), Ok((1030, 38)));
                }
            });
        }
    });
    // Ten bytes each.
    assert_eq!(line.heard(), 4 * 50 * 10);
}

#[test]
fn a_bus_that_another_thread_has_closed_is_closed() {
    let line = Line::new("closed", Peer::Answers(0));
    let bus = line.shared(Duration::from_millis(100));
    thread::scope(|scope| {
        scope.spawn(|| bus.close());
    });
    assert_eq!(bus.call(|bus| bus.ping(1)), Err(BusError::Closed));
    assert_eq!(stop(&bus), Err(BusError::Closed));
    bus.close();
}
