#![allow(clippy::unwrap_used)] // a test may

use std::{
    io::{BufRead, BufReader, Read},
    os::unix::{
        fs::{FileTypeExt, PermissionsExt},
        net::{UnixDatagram, UnixListener, UnixStream},
    },
    path::Path,
};

use haptether_safety::controller::PerController;
use rustix::net::{
    AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, socket_with,
};
use serde_json::Value as Json;

use super::*;
use crate::{FaultText, LadderState, Reason, coupling::CouplingKind, record::MasterRecord, wire::Role};

type Record = MasterRecord<2>;

/// Create an empty folder for the test `name`.
fn folder(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("haptether-telemetry-{}-{name}", std::process::id()));
    let _ = std::fs::remove_dir_all(&path);
    std::fs::create_dir(&path).unwrap();
    path
}

fn settings(path: &Path) -> TelemetrySettings {
    TelemetrySettings { path: path.to_owned(), security: SecurityMark::Insecure, scene: String::new() }
}

fn record(tick: u64) -> Record {
    Record {
        time_ns: tick * 1_000_000,
        position: [tick as f64, -0.5].into(),
        observers: PerController([0.25, f64::NAN, f64::INFINITY, f64::NAN]),
        state: LadderState::Engaged,
        ..Record::default()
    }
}

fn lines(bytes: &[u8]) -> Vec<Json> {
    let is_line = |line: &&[u8]| !line.is_empty();
    bytes
        .split(|byte| *byte == b'\n')
        .filter(is_line)
        .map(|line| serde_json::from_slice(line).unwrap())
        .collect()
}

fn of_kind<'a>(lines: &'a [Json], kind: &str) -> Vec<&'a Json> {
    lines.iter().filter(|line| line["kind"] == kind).collect()
}

/// Three dropped records; of 40 frames one missing and two late.
fn counts() -> Counts {
    let counts = Counts { dropped: 3.into(), ..Counts::default() };
    counts.count_link(&LinkStatistics {
        sent: 41,
        fresh: 37,
        late: 2,
        missing: 1,
        coupling: CouplingKind::Wave,
        ..LinkStatistics::default()
    });
    counts
}

fn framed(records: &[Record]) -> (Json, Vec<Json>) {
    let mut frame = Frame::of(&Record::any());
    for record in records {
        frame.take(record);
    }
    let mut changes = Vec::new();
    frame.events(|of| changes = lines(of));
    (lines(frame.sample(&counts()).unwrap().0).remove(0), changes)
}

#[test]
fn frame_has_minimum_maximum_and_last_of_each_axis() {
    let mut records: Vec<_> = (0..17).map(record).collect();
    // A spike of one tick.
    records[5].position[1] = 7.0;
    records[9].position[1] = -8.0;
    let (sample, _) = framed(&records);
    assert_eq!(sample["signals"]["position"], serde_json::json!([[0.0, 16.0, 16.0], [-8.0, 7.0, -0.5]]));
    assert_eq!(
        [&sample["ticks"], &sample["time_ns"], &sample["dropped"]],
        [&Json::from(17), &16_000_000.into(), &3.into()]
    );
    assert_eq!(
        sample["link"],
        serde_json::json!({"sent": 41, "fresh": 37, "late": 2, "missing": 1, "coupling": "wave"})
    );
}

#[test]
fn nan_does_not_change_the_bounds() {
    let mut records: Vec<_> = (0..3).map(record).collect();
    records[1].trigger = 0.5;
    records[0].trigger = f64::NAN;
    records[2].trigger = f64::NAN;
    let (sample, _) = framed(&records);
    assert_eq!(sample["signals"]["trigger"], serde_json::json!([0.5, 0.5, null]));
    let observers: Vec<_> =
        haptether_safety::controller::ControllerKind::ALL.map(|kind| kind.observed().column).to_vec();
    assert_eq!(sample["signals"][observers[0]], serde_json::json!([0.25, 0.25, 0.25]));
    assert_eq!(sample["signals"][observers[1]], serde_json::json!([null, null, null]));
}

#[test]
fn bits_of_any_tick_and_changes_survive() {
    let mut records: Vec<_> = (0..5).map(record).collect();
    records[2].tripped = 6;
    records[3].state = LadderState::Hold;
    records[4].state = LadderState::Hold;
    let (sample, changes) = framed(&records);
    assert_eq!(sample["signals"]["tripped"], serde_json::json!([6, 0]));
    assert_eq!(sample["signals"]["state"], "hold");
    let seen: Vec<_> = changes
        .iter()
        .map(|change| {
            (change["time_ns"].as_u64().unwrap(), &change["signal"], &change["from"], &change["to"])
        })
        .collect();
    let (tripped, state) = (Json::from("tripped"), Json::from("state"));
    assert_eq!(
        seen,
        [
            (2_000_000, &tripped, &0.into(), &6.into()),
            (3_000_000, &tripped, &6.into(), &0.into()),
            (3_000_000, &state, &"engaged".into(), &"hold".into()),
        ]
    );
}

/// A frame keeps nothing of the previous one, except the last value of a name.
#[test]
fn frames_follow_one_another() {
    let mut frame = Frame::of(&Record::any());
    frame.take(&Record { tripped: 2, ..record(9) });
    let _ = frame.sample(&Counts::default()).unwrap();
    assert!(frame.sample(&Counts::default()).is_none(), "a frame without a tick has no sample");
    frame.take(&Record { state: LadderState::Stop, ..record(1) });
    let sample = lines(frame.sample(&Counts::default()).unwrap().0).remove(0);
    assert_eq!(sample["signals"]["position"][0], serde_json::json!([1.0, 1.0, 1.0]));
    assert_eq!(sample["signals"]["tripped"], serde_json::json!([2, 0]), "it was on until this frame");
    let mut changes = Vec::new();
    frame.events(|of| changes = lines(of));
    assert_eq!(changes.len(), 2);
}

#[test]
fn excess_changes_are_counted() {
    let mut frame = Frame::of(&Record::any());
    for tick in 0..1000 {
        frame.take(&Record { clutch: tick % 2 == 0, ..record(tick) });
    }
    let mut changes = 0;
    frame.events(|of| changes = lines(of).len());
    assert_eq!(changes, 256);
    assert_eq!(lines(frame.sample(&Counts::default()).unwrap().0)[0]["unsent_changes"], 999 - 256);
}

#[test]
fn too_long_scene_is_omitted() {
    for (length, is_sent) in [(1 << 17, true), (1 << 18, false)] {
        let scene = format!("{{\"title\": \"{}\"}}", "x".repeat(length));
        let hello = frame::hello(&Record::any(), SecurityMark::Secure, &scene);
        assert!(hello.len() < 1 << 20);
        assert_eq!(lines(&hello)[0]["scene"].is_object(), is_sent);
    }
    assert!(lines(&frame::hello(&Record::any(), SecurityMark::Secure, ""))[0]["scene"].is_null());
}

#[test]
fn hello_names_every_signal_with_kind_and_size() {
    let hello =
        lines(&frame::hello(&Record::any(), SecurityMark::Secure, r#"{"safety": {"window": 20}}"#)).remove(0);
    assert_eq!([&hello["side"], &hello["security"]], ["master", "secure"]);
    assert_eq!(hello["scene"]["safety"]["window"], 20);
    assert_eq!(hello["version"], env!("CARGO_PKG_VERSION"));
    assert_eq!(hello["process"], std::process::id());
    let (sample, _) = framed(&[record(0)]);
    let signals = hello["signals"].as_array().unwrap();
    let names: Vec<_> = signals.iter().map(|signal| signal["name"].as_str().unwrap()).collect();
    let mut sorted = names.clone();
    sorted.sort_unstable();
    assert_eq!(sorted, sample["signals"].as_object().unwrap().keys().collect::<Vec<_>>());
    for signal in signals {
        let value = &sample["signals"][signal["name"].as_str().unwrap()];
        let is_right = match signal["kind"].as_str().unwrap() {
            "axes" => value.as_array().unwrap().len() == signal["size"],
            "number" => value.as_array().unwrap().len() == 3,
            "bits" => value.as_array().unwrap().len() == 2,
            "count" => value.is_u64(),
            "name" => value.is_string(),
            "flag" => value.is_boolean(),
            _ => false,
        };
        assert!(is_right, "{signal} {value}");
    }
}

fn read_to_end(mut stream: &UnixStream) -> Vec<Json> {
    let mut bytes = Vec::new();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    stream.read_to_end(&mut bytes).unwrap();
    lines(&bytes)
}

/// Read one line; a connected reader gets its first within a frame.
fn hello_of(stream: &UnixStream) -> Json {
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    let mut line = String::new();
    // One byte at a time, to leave the rest for later reads.
    BufReader::with_capacity(1, stream).read_line(&mut line).unwrap();
    serde_json::from_str(&line).unwrap()
}

const SILENT: Diagnosis = Diagnosis {
    role: Role::Master,
    state: LadderState::Hold,
    reason: Some(Reason::PeerSilent),
    fault: 0,
    text: FaultText::EMPTY,
    peer: None,
    ended: false,
    silent: true,
    ends: false,
};

/// A cleared cause is withdrawn from all readers, and later ones do not get it.
#[test]
fn cleared_cause_is_withdrawn() {
    let folder = folder("cleared");
    let path = folder.join("socket");
    let mut telemetry = Telemetry::<Record>::begin(&settings(&path)).unwrap();
    let first = UnixStream::connect(&path).unwrap();
    assert_eq!(hello_of(&first)["kind"], "hello");
    // Ignored: there is no cause to clear.
    telemetry.note(1, None);
    telemetry.note(2, Some(&SILENT));
    assert_eq!(hello_of(&first)["kind"], "cause");
    let second = UnixStream::connect(&path).unwrap();
    assert_eq!([hello_of(&second)["kind"].clone(), hello_of(&second)["kind"].clone()], ["hello", "cause"]);
    telemetry.note(3, None);
    let cleared = serde_json::json!({"kind": "cleared", "time_ns": 3});
    assert_eq!([hello_of(&first), hello_of(&second)], [cleared.clone(), cleared]);
    let third = UnixStream::connect(&path).unwrap();
    assert_eq!(hello_of(&third)["kind"], "hello");
    telemetry.end();
    assert_eq!(read_to_end(&third), [serde_json::json!({"kind": "end", "time_ns": 0})]);
}

/// After a panic, or for a loop that never began, readers get the records and no end line.
#[test]
fn abnormal_end_sends_no_end_line() {
    let folder = folder("panic");
    let path = folder.join("socket");
    let telemetry = Telemetry::<Record>::begin(&settings(&path)).unwrap();
    let reader = UnixStream::connect(&path).unwrap();
    assert_eq!(hello_of(&reader)["kind"], "hello");
    let looped = thread::spawn(move || {
        let mut telemetry = telemetry;
        telemetry.take(record(0));
        std::panic::resume_unwind(Box::new("a bug"));
    });
    looped.join().unwrap_err();
    let seen = read_to_end(&reader);
    assert_eq!((of_kind(&seen, "sample").len(), of_kind(&seen, "end").len()), (1, 0));
    assert!(!path.exists());
}

#[test]
fn each_reader_gets_all_ticks_and_the_end() {
    let folder = folder("all");
    let path = folder.join("socket");
    let mut telemetry = Telemetry::<Record>::begin(&settings(&path)).unwrap();
    let found = std::fs::metadata(&path).unwrap();
    assert!(found.file_type().is_socket() && found.permissions().mode() & 0o777 == 0o600);
    let readers = [(); 3].map(|()| UnixStream::connect(&path).unwrap());
    for reader in &readers {
        assert_eq!(hello_of(reader)["kind"], "hello");
    }
    for tick in 0..500 {
        telemetry.take(record(tick));
        if tick == 250 {
            telemetry.note(250_000_000, Some(&SILENT));
        }
    }
    telemetry.end();
    for reader in readers {
        let seen = read_to_end(&reader);
        let ticks: u64 = of_kind(&seen, "sample").iter().map(|line| line["ticks"].as_u64().unwrap()).sum();
        assert_eq!(ticks, 500);
        assert_eq!(of_kind(&seen, "cause")[0]["time_ns"], 250_000_000);
        assert_eq!(seen.last().unwrap(), &serde_json::json!({"kind": "end", "time_ns": 499_000_000}));
    }
    assert!(!path.exists(), "its socket is gone");
}

/// A stalled reader does not delay the others, and its losses are reported to it.
#[test]
fn stalled_reader_loses_samples_and_gets_their_count() {
    for reads_on in [true, false] {
        let folder = folder(&format!("stalled-{reads_on}"));
        let path = folder.join("socket");
        let mut readers = Readers::listen(&path, b"{\"kind\":\"hello\"}\n".to_vec()).unwrap();
        let [stalled, other] = [(); 2].map(|()| UnixStream::connect(&path).unwrap());
        readers.accept();
        readers.flush();
        let (has_read, read) = mpsc::channel();
        let reads = thread::spawn(move || {
            other.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
            let read = BufReader::new(other).lines().inspect(|_| {
                let _ = has_read.send(());
            });
            read.map(|line| serde_json::from_str(&line.unwrap()).unwrap()).collect::<Vec<Json>>()
        });
        // The line before the samples.
        read.recv_timeout(Duration::from_secs(20)).unwrap();
        let line = format!("{{\"kind\":\"sample\",\"ticks\":17,\"signals\":\"{}\"}}\n", "x".repeat(4000));
        let frames = |readers: &mut Readers| {
            for _ in 0..300 {
                readers.sample(line.as_bytes(), 17);
                readers.flush();
                // The other reader has read all before the next.
                read.recv_timeout(Duration::from_secs(20)).unwrap();
            }
        };
        frames(&mut readers);
        let seen = if reads_on {
            let reader = thread::spawn(move || read_to_end(&stalled));
            frames(&mut readers);
            readers.end(b"{\"kind\":\"end\"}\n", Duration::from_secs(5));
            reader.join().unwrap()
        } else {
            frames(&mut readers);
            let begun = Instant::now();
            let ender =
                thread::spawn(move || readers.end(b"{\"kind\":\"end\"}\n", Duration::from_millis(300)));
            ender.join().unwrap();
            assert!(begun.elapsed() < Duration::from_secs(5), "a stalled reader delays the end");
            let mut bytes = Vec::new();
            (&stalled).read_to_end(&mut bytes).unwrap();
            bytes.truncate(bytes.iter().rposition(|byte| *byte == b'\n').unwrap());
            lines(&bytes)
        };
        let sum = |lines: &[Json], kind: &str| -> u64 {
            of_kind(lines, kind).iter().map(|line| line["ticks"].as_u64().unwrap()).sum()
        };
        if reads_on {
            assert!(sum(&seen, "lost") > 0);
            assert_eq!(
                sum(&seen, "sample") + sum(&seen, "lost"),
                600 * 17,
                "each tick was sent or is counted"
            );
            assert_eq!(seen.last().unwrap()["kind"], "end");
        } else {
            assert!(sum(&seen, "sample") < 300 * 17);
        }
        let all = reads.join().unwrap();
        assert_eq!((sum(&all, "sample"), sum(&all, "lost")), (600 * 17, 0));
    }
}

#[test]
fn faster_loop_drops_and_counts_records() {
    let folder = folder("fast");
    let path = folder.join("socket");
    let mut telemetry = Telemetry::<Record>::begin(&settings(&path)).unwrap();
    let reader = UnixStream::connect(&path).unwrap();
    hello_of(&reader);
    for tick in 0..200_000 {
        telemetry.take(record(tick));
    }
    let dropped = telemetry.counts.dropped.load(Ordering::Relaxed);
    telemetry.end();
    let seen = read_to_end(&reader);
    let samples = of_kind(&seen, "sample");
    let ticks: u64 = samples.iter().map(|line| line["ticks"].as_u64().unwrap()).sum();
    assert!(dropped > 0);
    assert_eq!(ticks + dropped, 200_000);
    assert_eq!(samples.last().unwrap()["dropped"], dropped);
}

#[test]
fn invalid_path_is_refused_with_remedy() {
    let folder = folder("refused");
    let begin = |path: &Path| Telemetry::<Record>::begin(&settings(path)).map(|_| ());
    let refusal = |path: &Path| begin(path).unwrap_err().to_string();
    let file = folder.join("file");
    std::fs::write(&file, "mine").unwrap();
    assert!(refusal(&file).contains("is there and is no socket"));
    assert_eq!(std::fs::read(&file).unwrap(), b"mine");
    let link = folder.join("link");
    std::os::unix::fs::symlink(&file, &link).unwrap();
    assert!(refusal(&link).contains("is there and is no socket"));
    assert!(refusal(&folder.join("x".repeat(200))).contains("must be at most 107"));
    assert!(begin(&folder.join("none").join("socket")).is_err());
    let taken = folder.join("taken");
    let other = UnixListener::bind(&taken).unwrap();
    assert!(refusal(&taken).contains("another run"));
    assert!(taken.exists());
    drop(other);
    // Another kind of socket, and alive.
    let datagrams = folder.join("datagrams");
    let _other = UnixDatagram::bind(&datagrams).unwrap();
    assert!(refusal(&datagrams).contains("is another program's socket"));
    assert!(datagrams.exists());
    // Left behind by a killed run: the file exists, and nobody listens.
    let stale = folder.join("stale");
    drop(UnixListener::bind(&stale).unwrap());
    assert!(stale.exists());
    begin(&stale).unwrap();
    assert!(!stale.exists());
}

/// A full queue is neither awaited nor replaced.
#[test]
fn socket_with_full_queue_is_left_alone() {
    let folder = folder("full");
    let path = folder.join("socket");
    let address = SocketAddrUnix::new(&path).unwrap();
    let socket =
        || socket_with(AddressFamily::UNIX, SocketType::STREAM, SocketFlags::NONBLOCK, None).unwrap();
    let listener = socket();
    bind(&listener, &address).unwrap();
    listen(&listener, 1).unwrap();
    let mut waiting = Vec::new();
    loop {
        let client = socket();
        match connect(&client, &address) {
            Ok(()) => waiting.push(client),
            Err(error) => break assert_eq!(error, rustix::io::Errno::AGAIN),
        }
    }
    let text = Telemetry::<Record>::begin(&settings(&path)).unwrap_err().to_string();
    assert!(text.contains("another run"), "{text}");
    assert!(path.exists());
}

/// At a path with a stale socket, one of several concurrent runs gets it and keeps it.
#[test]
fn one_of_concurrent_runs_gets_the_path() {
    let folder = folder("at-once");
    let path = folder.join("socket");
    for _ in 0..50 {
        drop(UnixListener::bind(&path).unwrap());
        let begin = || {
            thread::spawn({
                let path = path.clone();
                move || Readers::listen(&path, b"{}\n".to_vec())
            })
        };
        let begun = [(); 4].map(|()| begin()).map(|thread| thread.join().unwrap());
        let (mut got, others): (Vec<_>, Vec<_>) = begun.into_iter().partition(Result::is_ok);
        assert_eq!(got.len(), 1);
        for other in others {
            let text = other.err().unwrap().to_string();
            assert!(text.contains("another run"), "{text}");
        }
        let client = UnixStream::connect(&path).unwrap();
        let mut readers = got.remove(0).unwrap();
        readers.accept();
        readers.flush();
        assert_eq!(hello_of(&client), serde_json::json!({}));
    }
    assert!(!path.exists());
}

#[test]
fn readers_come_and_go() {
    let folder = folder("come");
    let path = folder.join("socket");
    let mut telemetry = Telemetry::<Record>::begin(&settings(&path)).unwrap();
    for tick in 0..40 {
        let reader = UnixStream::connect(&path).unwrap();
        telemetry.take(record(tick));
        thread::sleep(FRAME / 2);
        drop(reader);
    }
    let many: Vec<_> = (0..20).map(|_| UnixStream::connect(&path).unwrap()).collect();
    let (read, refused): (Vec<_>, Vec<_>) =
        many.iter().map(|stream| (stream, hello_of(stream))).partition(|(_, first)| first["kind"] == "hello");
    assert_eq!((read.len(), refused.len()), (16, 4), "of 20, as many as there may be");
    telemetry.take(record(40));
    telemetry.end();
    for (stream, _) in read {
        assert_eq!(read_to_end(stream).last().unwrap()["kind"], "end");
    }
    for (stream, first) in refused {
        assert!(
            first["kind"] == "refused" && first["text"].as_str().unwrap().contains("16 programs"),
            "{first}"
        );
        assert!(read_to_end(stream).is_empty());
    }
}
