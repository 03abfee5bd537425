//! Cycle time of a servo bus on a pseudo-terminal: a read of current, velocity and position of all servos,
//! and a write of their goal currents, by this crate and by `dynamixel2`.
//!
//! `bus_cycle answer SERVOS BAUD` prints its pseudo-terminal and answers there until its standard input ends.
//! With a `BAUD` above 0 answers arrive when that many bit/s have carried them, including requests and writes
//! before them; with 0 at once.
//!
//! `bus_cycle run CLIENT PATH SERVOS CYCLES RATE` prints one line of JSON: the duration of each cycle in ns,
//! and the number of overruns. `CLIENT` is `fast` or `sync` of this crate, or `dynamixel2`, which has no fast
//! read. A `RATE` of 0 Hz starts each cycle when the previous one ends.
#![allow(clippy::unwrap_used)] // a bench: any failure ends it

use std::{
    env,
    io::{self, Read},
    path::Path,
    thread,
    time::{Duration, Instant},
};

use dynamixel2::instructions::SyncWriteData;
use haptether_dynamixel::{BROADCAST, Bus, Crc16, SyncRead, crc16};
use rustix::{
    fd::OwnedFd,
    io::{read, write},
    pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt},
    termios::{OptionalActions, tcgetattr, tcsetattr},
};
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadSchedulePolicy, set_thread_priority_and_policy,
    thread_native_id,
};

const PRESENT_CURRENT: u16 = 126;
const GOAL_CURRENT: u16 = 102;
/// Size of current, velocity and position in bytes.
const MEASURED: usize = 10;
const HEADER: [u8; 4] = [0xFF, 0xFF, 0xFD, 0x00];
const SYNC_READ: u8 = 0x82;
const FAST_SYNC_READ: u8 = 0x8A;
const STATUS: u8 = 0x55;
/// Start bit, eight bits, stop bit.
const BITS_PER_BYTE: u64 = 10;
const CLIENT_BAUD: u32 = 4_000_000;
const TIMEOUT_NS: u64 = 500_000_000;
const WARM_UP: usize = 50;

/// Measured values of a servo, without bytes that need stuffing.
fn measured(id: u8) -> [u8; MEASURED] {
    [id, 0, 1, 0, 0, 0, id, 8, 0, 0]
}

fn packet(id: u8, content: &[u8]) -> Vec<u8> {
    let length = u16::try_from(content.len() + 2).unwrap().to_le_bytes();
    let mut bytes = [&HEADER[..], &[id], &length, content].concat();
    bytes.extend(crc16(&bytes).to_le_bytes());
    bytes
}

/// Answers of all servos to a sync read and to a fast sync read.
fn answers(servos: u8) -> (Vec<u8>, Vec<u8>) {
    let one = |id| packet(id, &[&[STATUS, 0][..], &measured(id)].concat());
    let each = (1..=servos).flat_map(one).collect();
    // Each part ends with the checksum of everything before it.
    let length = u16::try_from(1 + usize::from(servos) * (MEASURED + 4)).unwrap().to_le_bytes();
    let mut fast = [&HEADER[..], &[BROADCAST], &length, &[STATUS]].concat();
    for id in 1..=servos {
        fast.extend([0, id]);
        fast.extend(measured(id));
        let mut crc = Crc16::default();
        crc.update(&fast);
        fast.extend(crc.value().to_le_bytes());
    }
    (each, fast)
}

fn terminal() -> (OwnedFd, String) {
    let ours = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&ours).unwrap();
    unlockpt(&ours).unwrap();
    let mut settings = tcgetattr(&ours).unwrap();
    settings.make_raw();
    tcsetattr(&ours, OptionalActions::Now, &settings).unwrap();
    let path = ptsname(&ours, Vec::new()).unwrap().into_string().unwrap();
    (ours, path)
}

/// Answer reads of all servos while the process lives.
fn answer(line: &OwnedFd, servos: u8, baud: u64) {
    let (each, fast) = answers(servos);
    let wire = |bytes: usize| {
        let bits = BITS_PER_BYTE * bytes as u64;
        bits.saturating_mul(1_000_000_000).checked_div(baud).map_or(Duration::ZERO, Duration::from_nanos)
    };
    let mut free = Instant::now();
    let mut pending: Vec<u8> = Vec::new();
    let mut buffer = [0; 1024];
    loop {
        // Reading fails while no client has the other end open.
        let Ok(count) = read(line, &mut buffer) else {
            pending.clear();
            thread::sleep(Duration::from_millis(1));
            continue;
        };
        pending.extend_from_slice(&buffer[..count]);
        while pending.len() >= 7 {
            let length = 7 + usize::from(u16::from_le_bytes([pending[5], pending[6]]));
            if pending.len() < length {
                break;
            }
            let reply: &[u8] = match pending[7] {
                SYNC_READ => &each,
                FAST_SYNC_READ => &fast,
                _ => &[],
            };
            free = free.max(Instant::now()) + wire(length + reply.len());
            pending.drain(..length);
            if reply.is_empty() {
                continue;
            }
            // The system wakes tens of microseconds late, as long as a servo's answer takes: spin instead.
            while Instant::now() < free {
                std::hint::spin_loop();
            }
            let mut rest = reply;
            while !rest.is_empty() {
                let Ok(count) = write(line, rest) else { break };
                rest = &rest[count..];
            }
        }
    }
}

fn client(name: &str, path: &str, servos: u8) -> Box<dyn FnMut()> {
    let ids: Vec<u8> = (1..=servos).collect();
    if name == "dynamixel2" {
        let mut bus = dynamixel2::Bus::open(path, CLIENT_BAUD).unwrap();
        let goals: Vec<_> = ids.iter().map(|&motor_id| SyncWriteData { motor_id, data: [1, 0] }).collect();
        return Box::new(move || {
            let mut answered = 0;
            let count = u16::try_from(MEASURED).unwrap();
            bus.sync_read_cb(&ids, PRESENT_CURRENT, count, |reply| {
                let reply = reply.unwrap();
                assert_eq!(reply.data, measured(reply.motor_id));
                answered += 1;
            })
            .unwrap();
            assert_eq!(answered, ids.len());
            bus.sync_write(GOAL_CURRENT, 2, &goals).unwrap();
        });
    }
    let fast = match name {
        "fast" => true,
        "sync" => false,
        other => panic!("client {other}: must be fast, sync or dynamixel2"),
    };
    let mut bus = Bus::open(Path::new(path), CLIENT_BAUD, TIMEOUT_NS).unwrap();
    let length = u16::try_from(MEASURED).unwrap();
    let mut read = SyncRead::new(fast, PRESENT_CURRENT, length, &ids).unwrap();
    let goals: Vec<u8> = ids.iter().flat_map(|_| [1, 0]).collect();
    Box::new(move || {
        bus.sync_read(&mut read).unwrap();
        for reply in read.replies().unwrap() {
            assert_eq!(reply.data, measured(reply.id));
        }
        bus.sync_write(GOAL_CURRENT, 2, &ids, &goals).unwrap();
    })
}

fn run(name: &str, path: &str, servos: u8, cycles: usize, rate: u32) {
    // As in a live loop; continues if it is refused.
    let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
    let priority = ThreadPriority::Crossplatform(50.try_into().unwrap());
    let real_time = set_thread_priority_and_policy(thread_native_id(), priority, fifo).is_ok();
    let mut cycle = client(name, path, servos);
    for _ in 0..WARM_UP {
        cycle();
    }
    let period = Duration::from_secs(1).checked_div(rate);
    let mut taken = Vec::with_capacity(cycles);
    let mut overruns = 0;
    let mut begin = Instant::now();
    for _ in 0..cycles {
        if let Some(period) = period {
            begin += period;
            let now = Instant::now();
            if now > begin {
                // A late cycle does not delay the next one.
                overruns += 1;
                begin = now;
            } else {
                thread::sleep(begin - now);
            }
        }
        let begun = Instant::now();
        cycle();
        taken.push(u64::try_from(begun.elapsed().as_nanos()).unwrap().to_string());
    }
    let taken = taken.join(",");
    println!(r#"{{"taken_ns": [{taken}], "overruns": {overruns}, "real_time": {real_time}}}"#);
}

fn main() {
    let arguments: Vec<String> = env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["answer", servos, baud] => {
            let (line, path) = terminal();
            println!("{path}");
            let (servos, baud) = (servos.parse().unwrap(), baud.parse().unwrap());
            thread::spawn(move || answer(&line, servos, baud));
            io::stdin().read_to_end(&mut Vec::new()).unwrap();
        }
        ["run", name, path, servos, cycles, rate] => {
            run(name, path, servos.parse().unwrap(), cycles.parse().unwrap(), rate.parse().unwrap());
        }
        _ => panic!("bus_cycle answer SERVOS BAUD, or run CLIENT PATH SERVOS CYCLES RATE"),
    }
}
