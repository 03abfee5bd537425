#![allow(clippy::unwrap_used)] // a test may

use proptest::prelude::*;

use super::*;
use crate::recorder::Recorded as _;
use crate::{
    ladder::LadderState,
    record::MasterRecord,
    recorder::{SecurityMark, file::McapFile},
};

/// File with this number of ticks in two chunks.
fn file(ticks: u64) -> Vec<u8> {
    let mut out = Vec::new();
    let mut file =
        McapFile::begin(&mut out, &MasterRecord::<2>::any(), SecurityMark::Secure, r#"{"run": {"seed": 7}}"#);
    file.begin_at_zero();
    for tick in 0..ticks {
        file.write(&MasterRecord::<2> {
            time_ns: 5 + tick * 1_000_000,
            position: [tick as f64 / 3.0, -0.1].into(),
            state: if tick == 0 { LadderState::Disengaged } else { LadderState::Engaged },
            age_ns: if tick == 0 { u64::MAX } else { 1000 * tick },
            ..MasterRecord::default()
        });
        if tick == ticks / 2 {
            assert_eq!(file.flush(), None);
        }
    }
    assert_eq!(file.finish(), None);
    out
}

fn read(bytes: &[u8]) -> ReadRecording {
    read_recording(bytes).unwrap()
}

fn values<'a>(of: &'a ReadRecording, name: &str) -> &'a Values {
    &of.columns.iter().find(|column| column.name == name).unwrap().values
}

#[test]
fn recorded_values_are_read_bit_for_bit() {
    let recording = read(&file(1000));
    assert!(recording.whole);
    assert_eq!((recording.ticks, recording.begun_ns), (1000, 0));
    assert_eq!(recording.about["side"], "master");
    assert_eq!(recording.about["scene"], r#"{"run": {"seed": 7}}"#);
    let rows = (0..1000).flat_map(|tick| [f64::from(tick) / 3.0, -0.1]).collect();
    assert_eq!(values(&recording, "position"), &Values::Axes { rows, width: 2 });
    assert_eq!(
        values(&recording, "time_ns"),
        &Values::Counts((0..1000).map(|tick| 5 + tick * 1_000_000).collect())
    );
    assert_eq!(values(&recording, "clutch"), &Values::Flags(vec![false; 1000]));
    assert_eq!(values(&recording, "trigger"), &Values::Unknown(1000));
    let names = vec!["disengaged".to_owned(), "engaged".to_owned()];
    let codes = (0..1000).map(|tick| u8::from(tick > 0)).collect();
    assert_eq!(values(&recording, "state"), &Values::Names { codes, names });
    let Values::Numbers(ages) = values(&recording, "age_s") else { panic!() };
    assert!(ages[0].is_nan());
    assert!((1..1000).all(|tick| ages[tick] == (1000 * tick) as f64 * 1e-9));
    let meanings: Vec<_> = recording.columns.iter().map(|column| column.meaning.as_str()).collect();
    assert!(meanings.contains(&"F_device in N") && meanings.iter().all(|meaning| !meaning.is_empty()));
}

#[test]
fn truncated_file_is_read_to_its_end() {
    let whole = file(20);
    let mut before = 0;
    for end in 0..whole.len() {
        let recording = read(&whole[..end]);
        assert!(!recording.whole, "{end}");
        assert!(recording.ticks >= before, "{end}: more of the file, no fewer ticks");
        before = recording.ticks;
    }
    assert_eq!(before, 20);
}

/// One invalid tick of 100: all others are read, to the end.
#[test]
fn only_the_invalid_tick_is_left_out() {
    let garbled: [(&[u8], &[u8]); 5] = [
        (b"{\"time_ns\":", b"}\"time_ns\":"),
        // The schema also contains the name, but no message begins with it there.
        (b"{\"time_ns\":", b"{\"time_ns\";"),
        (b"\"time_ns\":5", b"\"time_ns\":-"),
        (b"\"position\":[", b"\"position\":{"),
        (b"\"state\":\"", b"\"state\":7"),
    ];
    let whole = file(100);
    for (from, to) in garbled {
        assert_eq!(from.len(), to.len());
        let places: Vec<_> = (0..whole.len()).filter(|&at| whole[at..].starts_with(from)).collect();
        assert!(!places.is_empty(), "{}", String::from_utf8_lossy(from));
        for some in [&places[..1], &places[places.len() / 2..][..1], &places[places.len() - 1..]] {
            let mut bytes = whole.clone();
            for &at in some {
                bytes[at..at + to.len()].copy_from_slice(to);
            }
            let recording = read(&bytes);
            let found = (recording.ticks, recording.invalid, recording.damaged, recording.whole);
            assert_eq!(found, (99, 1, false, true), "{}", String::from_utf8_lossy(to));
        }
    }
}

#[test]
fn times_that_do_not_increase_from_zero_are_left_out() {
    let mut table = Table::new(vec![Column::new(TIME.to_owned(), String::new())]);
    for (time, is_taken) in
        [("-1", false), ("null", false), ("0.5", false), ("0", true), ("0", false), ("9", true), ("8", false)]
    {
        assert_eq!(table.push(format!(r#"{{"time_ns": {time}}}"#).as_bytes()), is_taken, "{time}");
    }
    assert_eq!(table.columns[0].values, Values::Counts(vec![0, 9]));
}

#[test]
fn invalid_bytes_differ_from_a_truncated_file() {
    let whole = file(20);
    let cut = read(&whole[..whole.len() / 2]);
    assert_eq!((cut.whole, cut.damaged), (false, false));
    let chunk =
        whole.windows(9).rposition(|at| at[0] == op::CHUNK && at[4..9] == [0; 5] && at[3] < 1).unwrap();
    let mut bytes = whole;
    // Length of the record, larger than any file.
    bytes[chunk + 1..chunk + 9].fill(127);
    let damaged = read(&bytes);
    assert_eq!((damaged.whole, damaged.damaged), (false, true));
    assert!(damaged.ticks > 0 && damaged.ticks < 20, "{}", damaged.ticks);
}

/// For a table of one signal: values in the messages, and expected column.
#[test]
fn a_message_that_does_not_fit_ends_the_reading() {
    let nan = f64::NAN;
    let rows: [(&[&str], Values); 17] = [
        (&["1", "null", "2"], Values::Numbers(vec![1.0, nan, 2.0])),
        (&["1", "2.5"], Values::Numbers(vec![1.0, 2.5])),
        (&["null", "null", "0.5"], Values::Numbers(vec![nan, nan, 0.5])),
        (&["true", "null"], Values::Numbers(vec![1.0, nan])),
        (&["-3", "9223372036854775807", "9223372036854775808"], Values::Counts(vec![-3, i64::MAX])),
        (&["1", "\"one\""], Values::Counts(vec![1])),
        (&["\"a\"", "\"b\"", "\"a\"", "null"], names(&[0, 1, 0], &["a", "b"])),
        (&["null", "\"a\""], Values::Unknown(1)),
        (&["[1, null]", "[2, 3]"], Values::Axes { rows: vec![1.0, nan, 2.0, 3.0], width: 2 }),
        (&["[1, 2]", "[3]"], Values::Axes { rows: vec![1.0, 2.0], width: 2 }),
        (&["[1, 2]", "[3, 4, 5]"], Values::Axes { rows: vec![1.0, 2.0], width: 2 }),
        (&["[1]", "[\"a\"]"], Values::Axes { rows: vec![1.0], width: 1 }),
        (&["[1]", "[[1]]"], Values::Axes { rows: vec![1.0], width: 1 }),
        (&["0.5", "{}"], Values::Numbers(vec![0.5])),
        (&["0.5", "1e999"], Values::Numbers(vec![0.5])),
        (&["0.5", "0.5}"], Values::Numbers(vec![0.5])),
        (&["0.5", "1, \"x\": 2"], Values::Numbers(vec![0.5])),
    ];
    for (messages, expected) in rows {
        let mut table = Table::new(vec![Column::new("x".to_owned(), String::new())]);
        let taken = messages
            .iter()
            .take_while(|value| table.push(format!(r#"{{"other": [{{}}], "x": {value}}}"#).as_bytes()))
            .count();
        assert_eq!(taken, table.ticks, "{messages:?}");
        // Compared as text, because NaN is not equal to NaN.
        assert_eq!(format!("{:?}", table.columns[0].values), format!("{expected:?}"), "{messages:?}");
    }
}

fn names(codes: &[u8], names: &[&str]) -> Values {
    Values::Names { codes: codes.to_vec(), names: names.iter().map(|name| (*name).to_owned()).collect() }
}

#[test]
fn signals_are_found_in_any_order() {
    let columns = ["a", "b", "c"].map(|name| Column::new(name.to_owned(), String::new()));
    let mut table = Table::new(columns.to_vec());
    for message in
        [r#"{"c":3,"a":1,"b":2}"#, r#"{"a":1,"c":3,"b":2}"#, r#"{"b":2,"c":3,"a":1}"#, r#"{"c":3}"#]
    {
        assert!(table.push(message.as_bytes()), "{message}");
    }
    let read: Vec<_> = table.columns.iter().map(|column| format!("{:?}", column.values)).collect();
    assert_eq!(
        read,
        ["Numbers([1.0, 1.0, 1.0, NaN])", "Numbers([2.0, 2.0, 2.0, NaN])", "Counts([3, 3, 3, 3])"]
    );
}

/// A file with many signals and many empty messages would need more memory than its own size.
#[test]
fn memory_is_bounded_by_what_was_read() {
    let columns = (0..MAX_COLUMNS).map(|name| Column::new(name.to_string(), String::new())).collect();
    let mut reading = Reading { table: Table::new(columns), bytes: 10 * MAX_COLUMNS, ..Reading::default() };
    reading.table.columns[0].name = "time_ns".to_owned();
    reading.table = Table::new(std::mem::take(&mut reading.table.columns));
    let taken =
        (0..100).take_while(|tick| reading.tick(0, format!(r#"{{"time_ns":{tick}}}"#).as_bytes())).count();
    assert_eq!(taken, 10);
}

#[test]
fn compressed_file_is_refused_with_the_compression_name() {
    let file = file(2);
    let mut bytes = file.clone();
    // In an uncompressed chunk the length of the compression name is 0. It follows 28 bytes after the opcode and the
    // length of the record.
    let chunk = file.windows(9).position(|at| at[0] == op::CHUNK && at[4..9] == [0; 5] && at[3] < 1).unwrap();
    let name_at = chunk + 9 + 28;
    assert_eq!(bytes[name_at..name_at + 4], [0; 4]);
    bytes.splice(name_at..name_at + 4, [4, 0, 0, 0, b'z', b's', b't', b'd']);
    let length = u64::from_le_bytes(bytes[chunk + 1..chunk + 9].try_into().unwrap()) + 4;
    bytes[chunk + 1..chunk + 9].copy_from_slice(&length.to_le_bytes());
    let refused = read_recording(&bytes[..]).unwrap_err().to_string();
    assert!(refused.starts_with("its chunks are compressed (zstd)"), "{refused}");
}

fn is_sound(bytes: &[u8]) {
    let Ok(recording) = read_recording(bytes) else { return };
    for column in &recording.columns {
        assert_eq!(column.ticks(), recording.ticks, "{}", column.name);
    }
}

/// Includes lengths that exceed their container.
#[test]
fn a_file_with_any_one_byte_changed_is_read_or_refused() {
    let file = file(6);
    for at in 0..file.len() {
        for byte in [0, 3, 255] {
            let mut bytes = file.clone();
            bytes[at] = byte;
            is_sound(&bytes);
        }
    }
}

proptest! {
    #[test]
    fn a_garbled_file_is_read_or_refused(changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8)) {
        let mut bytes = file(6);
        for (at, byte) in changes {
            let at = at.index(bytes.len());
            bytes[at] = byte;
        }
        is_sound(&bytes);
    }
}
