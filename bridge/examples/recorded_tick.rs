//! Cost of telemetry and recording in a live tick: `recorded_tick TICKS` prints one line of JSON.
//!
//! Four loops of a master with three axes tick in one thread at 1 kHz, in an order that changes each time. They run
//! without outputs, with telemetry and a reader, with a recording, and with both. Each tick is timed in ns from its
//! sample to its end: commands, socket, endpoint, frame, records.
#![allow(clippy::unwrap_used)] // a bench: any failure ends it

use std::{
    env,
    io::Read,
    net::{SocketAddr, UdpSocket},
    os::unix::net::UnixStream,
    path::Path,
    thread,
    time::{Duration, Instant},
};

use haptether_bridge::{
    Clutch, DrivenMaster, LadderSettings, MasterEndpoint, MasterSettings, MasterSide,
    live::{
        DriverLoop, LiveSettings, Newest, PacedLoop, PeerAddress, PeerSocket, RealtimeSettings,
        RecordOutputs, Security, paced_by_device,
    },
    recorder::{Recorder, RecorderSettings, SecurityMark},
    telemetry::{Telemetry, TelemetrySettings},
    wire::Role,
};
use haptether_safety::{
    Axes, DeviceModel, LimiterSettings,
    controller::{ControllerKind, SafetySettings},
    estimator::EstimatorKind,
};

const MS: u64 = 1_000_000;
const PERIOD: Duration = Duration::from_millis(1);
const WARM_UP: usize = 500;
const CASES: [(&str, bool, bool); 4] =
    [("none", false, false), ("telemetry", true, false), ("recording", false, true), ("both", true, true)];

type Loop = PacedLoop<MasterSide<DrivenMaster<3>, 3>>;

fn master() -> MasterSide<DrivenMaster<3>, 3> {
    let endpoint = MasterEndpoint::new(&MasterSettings {
        period_ns: MS,
        run_id: 1,
        device: DeviceModel::uniform(0.157, 0.0, 0.038).unwrap(),
        estimator: EstimatorKind::default(),
        safety: SafetySettings { controllers: ControllerKind::ALL.into(), ..SafetySettings::default() },
        limiter: LimiterSettings::default(),
        force_scale: 1.0,
        ladder: LadderSettings::default(),
    })
    .unwrap();
    let device = DrivenMaster { position: Axes::<3>::new(0.01, 0.02, 0.03), ..DrivenMaster::default() };
    MasterSide::new(device, endpoint, Clutch::Once).unwrap()
}

/// Return a started loop that sends to `peer`.
fn begun(folder: &Path, peer: SocketAddr, (name, telemetry, recording): (&str, bool, bool)) -> Loop {
    let path = folder.join(name);
    let outputs = RecordOutputs {
        newest: Newest::of(1000).unwrap(),
        recorder: recording.then(|| {
            Recorder::begin(&RecorderSettings {
                path: path.with_extension("mcap"),
                min_free_bytes: 0,
                security: SecurityMark::Insecure,
                scene: String::new(),
            })
            .unwrap()
        }),
        telemetry: telemetry.then(|| {
            Telemetry::begin(&TelemetrySettings {
                path: path.clone(),
                security: SecurityMark::Insecure,
                scene: String::new(),
            })
            .unwrap()
        }),
    };
    if telemetry {
        let mut reader = UnixStream::connect(&path).unwrap();
        thread::spawn(move || {
            let mut taken = vec![0; 1 << 16];
            while reader.read(&mut taken).is_ok_and(|count| count > 0) {}
        });
    }
    let settings = LiveSettings {
        role: Role::Master,
        period_ns: MS,
        duration_ns: None,
        patience_ns: None,
        started_ns: None,
        realtime: RealtimeSettings::default(),
    };
    let socket = PeerSocket::bind("127.0.0.1:0".parse().unwrap(), PeerAddress::Known(peer)).unwrap();
    let (mut paced, _, _) = paced_by_device(master(), socket, settings, Security::Insecure, outputs).unwrap();
    paced.begin().unwrap();
    paced
}

fn main() {
    let ticks: usize = env::args().nth(1).and_then(|text| text.parse().ok()).unwrap();
    let folder = env::temp_dir().join(format!("haptether-recorded-tick-{}", std::process::id()));
    std::fs::create_dir(&folder).unwrap();
    // The sink neither answers nor reads.
    let sink = UdpSocket::bind("127.0.0.1:0").unwrap();
    let peer = sink.local_addr().unwrap();
    let mut loops: Vec<Loop> = CASES.iter().map(|case| begun(&folder, peer, *case)).collect();
    let mut taken: Vec<Vec<u64>> = CASES.iter().map(|_| Vec::with_capacity(ticks)).collect();
    let mut due = Instant::now();
    for tick in 0..WARM_UP + ticks {
        due = (due + PERIOD).max(Instant::now());
        thread::sleep(due.saturating_duration_since(Instant::now()));
        for turn in 0..CASES.len() {
            let case = (tick + turn) % CASES.len();
            let mut sampled = Instant::now();
            // The device is read within the tick; a device that has not moved costs nothing.
            loops[case].step(None, |_| sampled = Instant::now(), |_| ()).unwrap();
            if tick >= WARM_UP {
                taken[case].push(u64::try_from(sampled.elapsed().as_nanos()).unwrap());
            }
        }
    }
    for one in &mut loops {
        one.end();
    }
    std::fs::remove_dir_all(&folder).unwrap();
    let rows: Vec<String> = CASES
        .iter()
        .zip(&taken)
        .map(|((name, ..), taken)| {
            let taken: Vec<String> = taken.iter().map(u64::to_string).collect();
            format!(r#""{name}": [{}]"#, taken.join(","))
        })
        .collect();
    println!("{{{}}}", rows.join(", "));
}
