//! Measurement of the proxy, whose statistics are the reference.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use super::live::{LOOPBACK, Running, settings, socket};
use crate::{
    Echo, EchoStatistics, LinkSettings, ProbeError, ProxySettings, ProxyStatistics, RecordSettings,
    Recording, record,
};

/// Send 500 probes through a proxy with these links.
fn measure(
    forward_link: LinkSettings,
    backward_link: LinkSettings,
) -> (Recording, ProxyStatistics, EchoStatistics) {
    let mut echo = Echo::bind(LOOPBACK).unwrap();
    let base = settings(echo.address().unwrap(), LinkSettings::default());
    let proxy = Running::start(&ProxySettings { forward_link, backward_link, ..base });
    let stop = AtomicBool::new(false);
    let asked = RecordSettings { peer: proxy.address, rate_hz: 1000.0, duration_s: 0.5, realtime: false };
    thread::scope(|scope| {
        let echoing = scope.spawn(|| echo.run(&stop).unwrap());
        let recording = record(&asked, &AtomicBool::new(false)).unwrap();
        stop.store(true, Ordering::Relaxed);
        (recording, proxy.stop().0, echoing.join().unwrap())
    })
}

fn median(mut of: Vec<f64>) -> f64 {
    of.sort_by(f64::total_cmp);
    of[of.len() / 2]
}

#[test]
fn different_delays_give_the_round_trip_and_half_of_it_each_way() {
    let link = |delay_s| LinkSettings { delay_s, ..LinkSettings::default() };
    let (recording, _, echo) = measure(link(0.01), link(0.03));
    assert_eq!((recording.probes.len(), echo.answered), (500, 500));
    assert_eq!((recording.lost_forward, recording.lost_backward), (0, 0));
    // No datagram is early, so this is the minimum round trip; the excess is scheduling.
    assert!((0.040..0.045).contains(&recording.shortest_s), "{}", recording.shortest_s);
    let forward = median(recording.probes.iter().filter_map(|probe| probe.forward_s).collect());
    let backward = median(recording.probes.iter().filter_map(|probe| probe.backward_s).collect());
    assert!((0.019..0.035).contains(&forward), "{forward}");
    assert!((0.019..0.035).contains(&backward), "{backward}");
    for pair in recording.probes.windows(2) {
        assert!(pair[0].sent_s < pair[1].sent_s);
    }
}

#[test]
fn losses_are_assigned_to_their_direction() {
    let link = |loss| LinkSettings { loss, delay_s: 0.002, ..LinkSettings::default() };
    let (recording, proxy, _) = measure(link(0.1), link(0.2));
    let lost = |of: fn(&crate::Probe) -> Option<f64>| {
        recording.probes.iter().filter(|probe| of(probe).is_none()).count() as u64
    };
    assert!(recording.lost_forward > 10 && recording.lost_backward > 20);
    assert_eq!(lost(|probe| probe.forward_s), recording.lost_forward);
    assert_eq!(lost(|probe| probe.backward_s), recording.lost_backward);
    // If the answers to the last probes are lost, the direction is unknown.
    assert_eq!(recording.lost_forward + recording.lost_backward, proxy.forward.lost + proxy.backward.lost);
    assert!(recording.lost_forward.abs_diff(proxy.forward.lost) <= 5, "{recording:?}");

    let mut text = Vec::new();
    recording.write_csv(&mut text).unwrap();
    let text = String::from_utf8(text).unwrap();
    let mut lines = text.lines().skip_while(|line| line.starts_with('#'));
    assert_eq!(lines.next(), Some("time_s,forward_delay_s,backward_delay_s"));
    assert_eq!(lines.clone().count(), 500);
    for (line, probe) in lines.zip(&recording.probes) {
        let cells: Vec<_> = line.split(',').collect();
        let [time, forward, backward] = cells[..] else { panic!("{line}") };
        assert!((time.parse::<f64>().unwrap() - probe.sent_s).abs() < 1e-9);
        assert_eq!(
            (forward.is_empty(), backward.is_empty()),
            (probe.forward_s.is_none(), probe.backward_s.is_none())
        );
    }
}

#[test]
fn other_datagrams_get_no_answer() {
    let mut echo = Echo::bind(LOOPBACK).unwrap();
    let address = echo.address().unwrap();
    let stop = AtomicBool::new(false);
    let statistics = thread::scope(|scope| {
        let echoing = scope.spawn(|| echo.run(&stop).unwrap());
        let client = socket();
        for size in [0, 1, 71, 72, 73, 1400] {
            client.send_to(&vec![0; size], address).unwrap();
        }
        thread::sleep(std::time::Duration::from_millis(50));
        client.set_nonblocking(true).unwrap();
        assert!(client.recv(&mut [0; 2000]).is_err());
        stop.store(true, Ordering::Relaxed);
        echoing.join().unwrap()
    });
    assert_eq!((statistics.answered, statistics.ignored), (0, 6));
}

#[test]
fn failed_measurements_are_explained() {
    let peer = socket().local_addr().unwrap();
    let good = RecordSettings { peer, rate_hz: 1000.0, duration_s: 0.01, realtime: false };
    let message = |settings| record(&settings, &AtomicBool::new(false)).unwrap_err().to_string();
    assert_eq!(
        message(RecordSettings { rate_hz: 1001.0, ..good }),
        "rate_hz = 1001: must be a finite number from 0.001 to 1000"
    );
    assert_eq!(
        message(RecordSettings { duration_s: f64::NAN, ..good }),
        "duration_s = NaN: must be a finite number from 0.001 to 10000"
    );
    let silent = record(&RecordSettings { duration_s: 0.005, ..good }, &AtomicBool::new(true));
    assert!(matches!(silent, Err(ProbeError::NoAnswer { sent: 0, .. })));
}
