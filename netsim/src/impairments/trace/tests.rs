use proptest::prelude::*;

use super::*;
use crate::{Direction, Link, Opportunities};

const MS: u64 = 1_000_000;
const CSV: &str = "# home, Sunday\ntime_s, delay_s\n0, 0.010\n\n1.0, 0.020\r\n2.0, lost\n3.0,\n4,0.03\n";
const TWO_WAY: &str = "time_s,forward_delay_s,backward_delay_s\n0,0.01,0.02\n0.5,lost,0.04\n";
const LINK: &str = "0\n3\n3\n10\n";
const DIST: &str = "# a table\n -32768 -100 0\n\t100 32767\n";
/// Shortened from the example in `irtt-client(1)`.
const IRTT: &str = r#"{
  "version": { "irtt": "0.9.0", "protocol": 1, "json_format": 1 },
  "config": { "params": { "interval": 200000000 } },
  "stats": { "rtt": { "mean": 1 } },
  "round_trips": [
    { "seqno": 0, "lost": "false",
      "timestamps": { "client": { "receive": { "wall": 1502871779, "monotonic": 2921143 },
                                  "send": { "wall": 1502727340, "monotonic": 2776704 } },
                      "server": { "receive": {}, "send": {} } },
      "delay": { "receive": 45177, "rtt": 134460, "send": 89283 }, "ipdv": {} },
    { "seqno": 1, "lost": "true_up",
      "timestamps": { "client": { "receive": {}, "send": { "wall": 1702727340, "monotonic": 202776704 } } },
      "delay": {}, "ipdv": {} },
    { "seqno": 2, "lost": "true_down",
      "timestamps": { "client": { "receive": {}, "send": { "wall": 1902727340, "monotonic": 402776704 } } },
      "delay": {}, "ipdv": {} },
    { "seqno": 3, "lost": true,
      "timestamps": { "client": { "receive": {}, "send": { "wall": 2102727340, "monotonic": 602776704 } } },
      "delay": {}, "ipdv": {} },
    { "seqno": 4, "lost": false,
      "timestamps": { "client": { "receive": {}, "send": { "wall": 2302727340, "monotonic": 802776704 } } },
      "delay": { "receive": 45268, "rtt": 99455, "send": 54187 }, "ipdv": { "rtt": -35005 } }
  ]
}"#;

#[test]
fn csv_is_read() {
    let read = parse_delay_csv(CSV.as_bytes(), Direction::Forward).unwrap();
    assert_eq!(read.time_s, [0.0, 1.0, 2.0, 3.0, 4.0]);
    assert_eq!(read.delay_s, [Some(0.01), Some(0.02), None, None, Some(0.03)]);
    assert!(read.interpolate && read.repeat);
    let forward = parse_delay_csv(TWO_WAY.as_bytes(), Direction::Forward).unwrap();
    let backward = parse_delay_csv(TWO_WAY.as_bytes(), Direction::Backward).unwrap();
    assert_eq!((forward.delay_s, backward.delay_s), (vec![Some(0.01), None], vec![Some(0.02), Some(0.04)]));
}

/// Quote as written by spreadsheets; first times from another clock, or before 0.
#[test]
fn quotes_and_any_first_time_are_read() {
    let plain = parse_delay_csv(b"time_s,delay_s\n0,0.01\n0.5,lost\n1.5,\n", Direction::Forward).unwrap();
    for text in [
        "\"time_s\",\"delay_s\"\r\n\"0\",\"0.01\"\r\n\"0.5\",\"lost\"\r\n\"1.5\",\"\"\r\n",
        "time_s,delay_s\n1700000000,0.01\n1700000000.5,lost\n1700000001.5,\n",
        "time_s,delay_s\n-4,0.01\n-3.5,lost\n-2.5,\n",
        " \"time_s\" , \" delay_s \"\n7,0.01\n7.5,lost\n8.5,\n",
    ] {
        assert_eq!(parse_delay_csv(text.as_bytes(), Direction::Forward).as_ref(), Ok(&plain), "{text}");
    }
    for (text, expected) in [
        ("time_s,delay_s\n5,1\n4,1\n", "line 3, column 1: time 4 s comes after 5 s"),
        ("time_s,delay_s\n-5,1\n1e9,1\n", "line 3, column 1: time 1000000000 s is more than"),
        ("time_s,delay_s\n\"0\", \"x\"\n", "line 2, column 7: delay = \"x\""),
        ("\"time_s,delay_s\n", "line 1, column 1: "),
    ] {
        let message = parse_delay_csv(text.as_bytes(), Direction::Forward).unwrap_err().to_string();
        assert!(message.starts_with(expected), "{message}\n{expected}");
    }
}

#[test]
fn link_traces_and_tables_are_read() {
    assert_eq!(parse_mahimahi(LINK.as_bytes()), Ok(Opportunities { time_ms: vec![0, 3, 3, 10] }));
    assert_eq!(parse_dist(DIST.as_bytes()), Ok(vec![-32768, -100, 0, 100, 32767]));
}

#[test]
fn irtt_places_delays_and_losses() {
    let forward = parse_irtt(IRTT.as_bytes(), Direction::Forward).unwrap();
    assert_eq!(forward.measured, IrttDelay::OneWay);
    assert_eq!(forward.delays.time_s, [0.0, 0.2, 0.6, 0.8]);
    assert_eq!(forward.delays.delay_s, [Some(89_283e-9), None, None, Some(54_187e-9)]);
    let backward = parse_irtt(IRTT.as_bytes(), Direction::Backward).unwrap();
    assert_eq!(backward.delays.time_s, [0.0, 0.4, 0.6, 0.8]);
    assert_eq!(backward.delays.delay_s, [Some(45_177e-9), None, None, Some(45_268e-9)]);
}

#[test]
fn irtt_halves_round_trips_where_one_way_delays_are_not_plausible() {
    for text in [IRTT.replace("\"send\": 54187", "\"send\": -7"), IRTT.replace(", \"send\": 89283", "")] {
        let read = parse_irtt(text.as_bytes(), Direction::Backward).unwrap();
        assert_eq!(read.measured, IrttDelay::HalfRoundTrip);
        assert_eq!(read.delays.delay_s, [Some(67_230e-9), None, None, Some(49_727.5e-9)]);
    }
}

#[test]
fn irtt_without_times_of_sending_counts_intervals() {
    let text = r#"{"round_trips": [{"seqno": 3, "lost": false, "delay": {"rtt": 2000}}, {"seqno": 5, "lost": true}],
        "config": {"params": {"interval": 1000000}}}"#;
    let read = parse_irtt(text.as_bytes(), Direction::Forward).unwrap();
    assert_eq!((read.delays.time_s, read.delays.delay_s), (vec![0.0, 0.002], vec![Some(1e-6), None]));
}

fn csv(text: &[u8]) -> Result<(), ParseError> {
    parse_delay_csv(text, Direction::Forward).map(drop)
}

fn irtt(text: &[u8]) -> Result<(), ParseError> {
    parse_irtt(text, Direction::Forward).map(drop)
}

fn link(text: &[u8]) -> Result<(), ParseError> {
    parse_mahimahi(text).map(drop)
}

fn dist(text: &[u8]) -> Result<(), ParseError> {
    parse_dist(text).map(drop)
}

const USUAL: &[u8] = b"0123456789-.,\n\"{}[] e";

type Parser = fn(&[u8]) -> Result<(), ParseError>;
const PARSERS: [(Parser, &str); 5] = [(csv, CSV), (csv, TWO_WAY), (irtt, IRTT), (link, LINK), (dist, DIST)];

#[test]
fn an_error_says_where_it_is() {
    let cases: [(Parser, &[u8], &str); 25] = [
        (csv, b"", "line 1, column 1: no header"),
        (csv, b"time_s,delay_s\n", "line 1, column 1: no records"),
        (csv, b"0,1\n", "line 1, column 1: \"0,1\" is no header"),
        (csv, b"time_s,delay_s\n0, x\n", "line 2, column 4: delay = \"x\": must be a number from 0 to 3600"),
        (csv, b"time_s,delay_s\n0,nan\n", "line 2, column 3: delay"),
        (csv, b"time_s,delay_s\n0,-1\n", "line 2, column 3: delay"),
        (csv, b"time_s,delay_s\ninf,1\n", "line 2, column 1: time"),
        (csv, b"time_s,delay_s\n0\n", "line 2, column 2: 1 fields; there must be 2"),
        (csv, b"time_s,delay_s\n0,1,2\n", "line 2, column 5: more than 2 fields"),
        (csv, b"time_s,delay_s\n1,1\n1,1\n", "line 3, column 1: time 1 s comes after 1 s"),
        (csv, b"time_s,delay_s\n\xFF,1\n", "line 2, column 1: not text"),
        (csv, &[b' '; 5000], "line 1, column 4097: the line has 5000 bytes"),
        (link, b"", "line 1, column 1: \"\": must be a whole number of ms"),
        (link, b"1\n\n2\n", "line 2, column 1: \"\": must be a whole number of ms"),
        (link, b"5\n4\n", "line 2, column 1: 4 ms comes after 5 ms"),
        (link, b"0\n0\n", "line 2, column 1: the last time is 0 ms"),
        (link, b"+1\n", "line 1, column 1: \"+1\": must be a whole number of ms"),
        (dist, b"# none\n", "line 1, column 1: no values"),
        (dist, b"1 2\n3  32768", "line 2, column 4: \"32768\": must be a whole number"),
        (irtt, b"\x1F\x8B\x08", "line 1, column 1: compressed by gzip"),
        (irtt, b"{}", "line 1, column 2: missing field `round_trips`"),
        (irtt, b"{\"round_trips\": []}", "line 1, column 1: no round trips"),
        (irtt, b"{\"round_trips\":\n [{\"seqno\": 0}]}", "line 2, column 14: missing field `lost`"),
        (irtt, b"{\"round_trips\":\n [{\"seqno\": 0, \"lost\": false}]}", "line 2, column"),
        (irtt, b"{\"round_trips\":\n [{\"seqno\": 0, \"lost\": \"maybe\"}]}", "line 2, column"),
    ];
    for (parser, text, expected) in cases {
        let message = parser(text).unwrap_err().to_string();
        assert!(message.starts_with(expected), "{message}\n{expected}");
        assert!(!message.contains(" at line "), "{message}");
    }
    let long =
        vec![b"1 ".as_slice(); 16_385].chunks(1000).map(<[_]>::concat).collect::<Vec<_>>().join(&b'\n');
    assert_eq!(dist(&long).unwrap_err().to_string(), "line 17, column 769: more than 16384 values");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(4000))]

    #[test]
    fn random_bytes_break_no_parser(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        for (parser, _) in PARSERS {
            if let Err(error) = parser(&bytes) {
                prop_assert!(error.line >= 1 && error.column >= 1, "{}", error);
            }
        }
    }

    /// Replaces, removes and duplicates bytes of a valid file.
    #[test]
    fn a_mutated_file_breaks_no_parser(
        mutations in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 0..4_u8), 1..8),
    ) {
        for (parser, good) in PARSERS {
            prop_assert!(parser(good.as_bytes()).is_ok());
            let mut bytes = good.as_bytes().to_vec();
            for &(index, byte, how) in &mutations {
                let position = index.index(bytes.len());
                match how {
                    0 => bytes[position] = byte,
                    // A byte that is typical of such files.
                    1 => bytes[position] = USUAL[usize::from(byte) % USUAL.len()],
                    2 => drop(bytes.remove(position)),
                    _ => bytes.extend_from_within(position..),
                }
            }
            if let Err(error) = parser(&bytes) {
                let lines = bytes.split(|&byte| byte == b'\n').count();
                prop_assert!((1..=lines).contains(&error.line) && error.column >= 1, "{}", error);
            }
        }
    }
}

fn replay(trace: DelayTrace, sent_s: f64) -> Option<u64> {
    let settings = LinkSettings { trace: Some(trace), keep_order: false, ..LinkSettings::default() };
    let mut link = Link::new(Direction::Forward, 0, &settings).unwrap();
    let packet = Packet { direction: Direction::Forward, sent_ns: nanoseconds(sent_s), size: 64, index: 0 };
    match link.judge(&packet).verdict {
        Verdict::Deliver { at_ns } => Some(at_ns - packet.sent_ns),
        Verdict::Drop { cause } => {
            assert_eq!(cause, DropCause::Trace);
            None
        }
    }
}

#[test]
fn a_recording_is_replayed_from_its_first_record_and_over_again() {
    let recorded = |interpolate, repeat| DelayTrace {
        time_s: vec![1000.5, 1001.0, 1002.0, 1004.0],
        delay_s: vec![Some(0.010), Some(0.020), None, Some(0.030)],
        interpolate,
        repeat,
    };
    // The period is 3.5 s + 2 s.
    let cases = [
        (0.0, Some(10 * MS)),
        (0.25, Some(15 * MS)),
        (0.5, Some(20 * MS)),
        // The next record was lost: no interpolation.
        (1.4, Some(20 * MS)),
        (1.5, None),
        (3.499, None),
        (3.5, Some(30 * MS)),
        (5.4, Some(30 * MS)),
        (5.5, Some(10 * MS)),
        (5.75, Some(15 * MS)),
        (5.5e8 + 2.5, None),
    ];
    for (sent_s, delay_ns) in cases {
        assert_eq!(replay(recorded(true, true), sent_s), delay_ns, "{sent_s}");
    }
    assert_eq!(replay(recorded(false, true), 0.25), Some(10 * MS));
    assert_eq!(replay(recorded(true, false), 6.25), Some(30 * MS));
    let single =
        DelayTrace { time_s: vec![1.0], delay_s: vec![Some(0.007)], interpolate: true, repeat: true };
    for sent_s in [0.0, 1.0, 100.0] {
        assert_eq!(replay(single.clone(), sent_s), Some(7 * MS));
    }
    let lost = DelayTrace { delay_s: vec![None], ..single };
    assert_eq!(replay(lost, 3.0), None);
}

#[test]
fn interpolation_falls_as_it_rises() {
    assert_eq!((between(10, 20, 1, 4), between(20, 10, 1, 4), between(5, 5, 3, 4)), (12, 18, 5));
    assert_eq!(between(0, u64::MAX, u64::MAX, u64::MAX), u64::MAX);
}

#[test]
fn an_invalid_recording_is_refused() {
    let trace = |time_s: &[f64], delay_s: &[Option<f64>]| {
        let trace = DelayTrace {
            time_s: time_s.to_vec(),
            delay_s: delay_s.to_vec(),
            interpolate: true,
            repeat: true,
        };
        LinkSettings { trace: Some(trace), ..LinkSettings::default() }
    };
    let good = trace(&[0.0, 1.0], &[Some(0.1), None]);
    assert!(good.validate().is_ok());
    let cases = [
        (trace(&[], &[]), "trace: 0 times"),
        (trace(&[0.0], &[]), "trace: 1 times and 0 delays"),
        (trace(&[0.0, 0.0], &[None, None]), "trace.time_s.1: 0 s"),
        (trace(&[0.0, f64::NAN], &[None, None]), "trace.time_s.1 = NaN"),
        (trace(&[0.0], &[Some(-1.0)]), "trace.delay_s.0 = -1"),
        (LinkSettings { delay_s: 0.1, ..good.clone() }, "trace: given beside delay_s"),
        (LinkSettings { jitter_s: 0.1, ..good }, "trace: given beside jitter_s"),
    ];
    for (settings, expected) in cases {
        let message = settings.validate().unwrap_err().to_string();
        assert!(message.starts_with(expected), "{message}");
    }
}
