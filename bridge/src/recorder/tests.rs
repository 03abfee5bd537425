use std::{
    io::{self, Write},
    sync::{Mutex, mpsc},
};

use haptether_safety::controller::PerController;

use super::*;
use crate::{FaultText, LadderState, PeerCause, Reason, record::MasterRecord, wire::Role};

const SETTINGS: RecorderSettings = RecorderSettings {
    path: PathBuf::new(),
    min_free_bytes: 0,
    security: SecurityMark::Insecure,
    scene: String::new(),
};

fn record(tick: u64) -> MasterRecord<2> {
    MasterRecord {
        time_ns: tick * 1_000_000,
        position: [tick as f64, -0.1].into(),
        observers: PerController([0.25, f64::NAN, f64::INFINITY, f64::NAN]),
        state: LadderState::Engaged,
        reason: 1,
        age_ns: u64::MAX,
        round_trip_ns: 2_000_000,
        ..MasterRecord::default()
    }
}

/// Written bytes, shared with the test.
#[derive(Clone, Default)]
struct Written(Arc<Mutex<Vec<u8>>>);

impl Written {
    fn read(&self) -> Vec<u8> {
        self.0.lock().unwrap().clone()
    }
}

/// Disk with `room` bytes; each write waits for `gate`.
struct Disk {
    paper: Written,
    room: usize,
    gate: Option<mpsc::Receiver<()>>,
}

impl Write for Disk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if let Some(gate) = &self.gate {
            // A dropped sender leaves the gate open.
            let _ = gate.recv();
        }
        let taken = bytes.len().min(self.room);
        if taken == 0 {
            return Err(rustix::io::Errno::NOSPC.into());
        }
        self.room -= taken;
        self.paper.0.lock().unwrap().extend_from_slice(&bytes[..taken]);
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn disk(room: usize) -> (Disk, Written) {
    let paper = Written::default();
    (Disk { paper: paper.clone(), room, gate: None }, paper)
}

/// Return the readable messages of a complete or incomplete file.
fn messages(file: &[u8]) -> Vec<serde_json::Value> {
    mcap::MessageStream::new_with_options(file, mcap::read::Options::IgnoreEndMagic.into())
        .unwrap()
        .map_while(Result::ok)
        .map(|message| serde_json::from_slice(&message.data).unwrap())
        .collect()
}

/// Pass on records like a loop that waits for the disk.
fn take_slowly(recorder: &mut Recorder<MasterRecord<2>>, count: u64) {
    for tick in 0..count {
        while recorder.records.is_full() {
            std::thread::yield_now();
        }
        recorder.take(record(tick));
    }
}

#[test]
fn recorded_messages_can_be_read() {
    let (disk, paper) = disk(usize::MAX);
    let mut recorder = Recorder::write_to(disk, || u64::MAX, &SETTINGS).unwrap();
    take_slowly(&mut recorder, 1000);
    assert_eq!(recorder.end(), RecordingReport { written: 1000, dropped: 0, end: None });
    let file = paper.read();
    let read = messages(&file);
    assert_eq!(read.len(), 1000);
    for (tick, message) in read.iter().enumerate() {
        assert_eq!(message["time_ns"], tick * 1_000_000);
        assert_eq!(message["position"], serde_json::json!([tick as f64, -0.1]));
        assert_eq!(message["velocity_force"], 0.25);
        assert!(message["grasp"].is_null() && message["windowed_energy_j"].is_null());
        assert!(message["age_s"].is_null());
        assert_eq!(message["round_trip_s"], 0.002);
        assert_eq!(message["state"], "engaged");
        assert_eq!(message["security"], "insecure");
    }
    let summary = mcap::Summary::read(&file).unwrap().unwrap();
    assert_eq!(summary.stats.unwrap().message_count, 1000);
    let channel = summary.channels.values().find(|channel| channel.topic == "/master").unwrap();
    assert_eq!(channel.message_encoding, "json");
    assert_eq!(channel.metadata["security"], "insecure");
    let schema = channel.schema.as_ref().unwrap();
    assert_eq!((schema.name.as_str(), schema.encoding.as_str()), ("haptether.master", "jsonschema"));
    let described: serde_json::Value = serde_json::from_slice(&schema.data).unwrap();
    let described: Vec<&String> = described["properties"].as_object().unwrap().keys().collect();
    let written: Vec<&String> = read[0].as_object().unwrap().keys().collect();
    assert_eq!(described, written);
}

#[test]
fn a_recording_keeps_its_scene_and_version() {
    let about = |scene: &str| {
        let (disk, paper) = disk(usize::MAX);
        let settings = RecorderSettings { scene: scene.to_owned(), ..SETTINGS };
        Recorder::<MasterRecord<2>>::write_to(disk, || u64::MAX, &settings).unwrap().end();
        let file = paper.read();
        let summary = mcap::Summary::read(&file).unwrap().unwrap();
        mcap::read::metadata(&file, &summary.metadata_indexes[0]).unwrap().metadata
    };
    let scene = r#"{"schema": 1, "title": "a \u00e4 \"title\""}"#;
    assert_eq!(about(scene)["scene"], scene);
    assert_eq!(about(scene)["version"], env!("CARGO_PKG_VERSION"));
    assert!(!about("").contains_key("scene"));
}

#[test]
fn messages_are_logged_at_the_wall_clock_of_the_run() {
    let wall_ns = || {
        let since_epoch = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        u64::try_from(since_epoch.unwrap().as_nanos()).unwrap()
    };
    let (disk, paper) = disk(usize::MAX);
    let before = wall_ns();
    let mut recorder = Recorder::write_to(disk, || u64::MAX, &SETTINGS).unwrap();
    recorder.start(crate::live::now_ns() - 5_000_000_000);
    take_slowly(&mut recorder, 2);
    recorder.end();
    let after = wall_ns();
    let file = paper.read();
    let times: Vec<u64> =
        mcap::MessageStream::new(&file).unwrap().map(|message| message.unwrap().log_time).collect();
    assert!((before..=after).contains(&(times[0] + 5_000_000_000)), "{times:?} {before} {after}");
    assert_eq!(times[1] - times[0], 1_000_000);
}

#[test]
fn causes_of_decoupling_have_their_own_channel() {
    let (disk, paper) = disk(usize::MAX);
    let mut recorder = Recorder::write_to(disk, || u64::MAX, &SETTINGS).unwrap();
    take_slowly(&mut recorder, 10);
    let text = FaultText::new("the bus is down");
    let peer = PeerCause { state: LadderState::Fault, reason: 1, fault: 11, text };
    let diagnosis = Diagnosis {
        role: Role::Master,
        state: LadderState::Hold,
        reason: Some(Reason::PeerFaulted),
        fault: 0,
        text: FaultText::EMPTY,
        peer: Some(peer),
        ended: false,
        silent: false,
        ends: false,
    };
    recorder.note(7_000_000, &diagnosis);
    recorder.end();
    let file = paper.read();
    let causes: Vec<_> = mcap::MessageStream::new(&file)
        .unwrap()
        .map(Result::unwrap)
        .filter(|message| message.channel.topic == "/master/cause")
        .collect();
    assert_eq!(causes.len(), 1);
    let written: serde_json::Value = serde_json::from_slice(&causes[0].data).unwrap();
    assert_eq!(written["text"], "the slave has a fault: the bus is down");
    assert_eq!((written["at"].as_str(), written["time_ns"].as_u64()), (Some("slave"), Some(7_000_000)));
    let schema = causes[0].channel.schema.as_ref().unwrap();
    let described: serde_json::Value = serde_json::from_slice(&schema.data).unwrap();
    let keys =
        |value: &serde_json::Value| -> Vec<String> { value.as_object().unwrap().keys().cloned().collect() };
    assert_eq!(keys(&described["properties"]), keys(&written));
    assert_eq!(keys(&described["properties"]["steps"]["items"]["properties"]), keys(&written["steps"][0]));
}

#[test]
fn stuck_disk_costs_records_but_no_time() {
    let (open, gate) = mpsc::channel();
    let (mut disk, paper) = disk(usize::MAX);
    disk.gate = Some(gate);
    let mut recorder = Recorder::write_to(disk, || u64::MAX, &SETTINGS).unwrap();
    let offered = 3 * RING as u64;
    // Nothing here waits: the gate is closed, and all records are passed on.
    (0..offered).for_each(|tick| recorder.take(record(tick)));
    assert!(recorder.records.is_full());
    assert_eq!(recorder.recording().report().written, 0);
    drop(open);
    let report = recorder.end();
    assert_eq!((report.written + report.dropped, report.end), (offered, None));
    assert!(report.written >= RING as u64 && report.dropped > 0, "{report:?}");
    assert_eq!(messages(&paper.read()).len() as u64, report.written);
}

#[test]
fn run_ends_while_the_disk_is_stuck() {
    let (open, gate) = mpsc::channel();
    let (mut disk, _) = disk(usize::MAX);
    disk.gate = Some(gate);
    let mut recorder = Recorder::write_to(disk, || u64::MAX, &SETTINGS).unwrap();
    (0..10).for_each(|tick| recorder.take(record(tick)));
    let report = recorder.end();
    assert_eq!(report, RecordingReport { written: 0, dropped: 10, end: Some(RecordingEnd::Stuck) });
    drop(open);
}

#[test]
fn full_disk_ends_the_recording_and_leaves_it_readable() {
    for room in [0, 10, 100_000, 500_000] {
        let (disk, paper) = disk(room);
        let mut recorder = Recorder::write_to(disk, || u64::MAX, &SETTINGS).unwrap();
        take_slowly(&mut recorder, 5000);
        let report = recorder.end();
        let full = rustix::io::Errno::NOSPC.raw_os_error();
        assert_eq!(report.end, Some(RecordingEnd::Refused(full)), "{room}");
        assert_eq!(report.written + report.dropped, 5000);
        assert_eq!(report.written > 0, room >= 500_000, "{report:?}");
        if room > 10 {
            // A chunk that was only partly written can be read in part.
            let read = messages(&paper.read()).len() as u64;
            assert!((report.written..report.written + CHUNK).contains(&read), "{read}, {report:?}");
        }
    }
}

#[test]
fn too_little_space_ends_the_recording_with_a_complete_file() {
    let (disk, paper) = disk(usize::MAX);
    let looked = std::cell::Cell::new(0);
    let free = move || {
        looked.set(looked.get() + 1);
        if looked.get() < 3 { 100 } else { 99 }
    };
    let settings = RecorderSettings { min_free_bytes: 100, ..SETTINGS };
    let mut recorder = Recorder::write_to(disk, free, &settings).unwrap();
    take_slowly(&mut recorder, 5000);
    let report = recorder.end();
    assert_eq!(report.end, Some(RecordingEnd::LowSpace));
    assert!(report.written > 0 && report.written + report.dropped == 5000, "{report:?}");
    let summary = mcap::Summary::read(&paper.read()).unwrap().unwrap();
    assert_eq!(summary.stats.unwrap().message_count, report.written);
}

#[test]
fn a_recording_that_cannot_begin_touches_no_file() {
    let path = std::env::temp_dir().join(format!("haptether-recorder-{}", std::process::id()));
    std::fs::write(&path, "before").unwrap();
    let settings = RecorderSettings { path: path.clone(), min_free_bytes: u64::MAX - 1, ..SETTINGS };
    let error = Recorder::<MasterRecord<2>>::begin(&settings).unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::StorageFull);
    assert!(error.to_string().contains("must be at least 18446744073709551614"), "{error}");
    assert_eq!(std::fs::read(&path).unwrap(), b"before");
    std::fs::remove_file(&path).unwrap();
    let nowhere = RecorderSettings { path: path.join("beneath"), ..settings };
    assert_eq!(Recorder::<MasterRecord<2>>::begin(&nowhere).unwrap_err().kind(), io::ErrorKind::NotFound);
}

/// The index stays in memory until the end of the file and grows by chunk. Chunks are complete even if records come
/// slowly.
#[test]
fn chunks_are_whole_and_the_index_of_a_file_is_small() {
    let (disk, paper) = disk(usize::MAX);
    let mut recorder = Recorder::write_to(disk, || u64::MAX, &SETTINGS).unwrap();
    for tick in 0..600 {
        recorder.take(record(tick));
        if tick % 50 == 0 {
            std::thread::sleep(Duration::from_millis(25));
        }
    }
    assert_eq!(recorder.end(), RecordingReport { written: 600, dropped: 0, end: None });
    let summary = mcap::Summary::read(&paper.read()).unwrap().unwrap();
    assert_eq!(summary.chunk_indexes.len(), 3);
}

#[test]
fn recording_is_private_to_its_owner_and_follows_no_link() {
    use std::os::unix::fs::{PermissionsExt, symlink};

    let folder = std::env::temp_dir().join(format!("haptether-recordings-{}", std::process::id()));
    std::fs::create_dir(&folder).unwrap();
    let settings = |name| RecorderSettings { path: folder.join(name), ..SETTINGS };
    let mode = |name| std::fs::metadata(folder.join(name)).unwrap().permissions().mode() & 0o777;
    std::fs::write(folder.join("old"), "before").unwrap();
    std::fs::set_permissions(folder.join("old"), std::fs::Permissions::from_mode(0o644)).unwrap();
    for name in ["new", "old"] {
        Recorder::<MasterRecord<2>>::begin(&settings(name)).unwrap().end();
        assert_eq!(mode(name), 0o600, "{name}");
        assert!(mcap::Summary::read(&std::fs::read(folder.join(name)).unwrap()).unwrap().is_some());
    }
    std::fs::write(folder.join("victim"), "before").unwrap();
    for (name, to) in [("planted", "victim"), ("dangling", "nowhere")] {
        symlink(folder.join(to), folder.join(name)).unwrap();
        let error = Recorder::<MasterRecord<2>>::begin(&settings(name)).unwrap_err();
        assert!(error.to_string().contains("is a symbolic link, must be a file"), "{error}");
    }
    assert_eq!(std::fs::read(folder.join("victim")).unwrap(), b"before");
    assert!(!folder.join("nowhere").exists());
    std::fs::remove_dir_all(&folder).unwrap();
}
