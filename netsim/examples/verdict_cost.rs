//! Cost of one packet in a virtual-time network: its verdict and its passage through the queue.
//!
//! `verdict_cost [LINK [PACKETS]]`: prints ns per packet of each link, or of the named one. Both directions
//! alternate at 1 kHz, as in a run of two sides. Times on a shared processor are noisy; instruction counts
//! are not:
//!
//! ```text
//! valgrind --tool=callgrind --callgrind-out-file=/dev/null target/release/examples/verdict_cost rough 100000
//! ```
//!
//! Subtract the count for half as many packets, and divide by the difference in packets.

use std::error::Error;
use std::hint::black_box;
use std::time::Instant;

use haptether_netsim::{Direction, InFlight, Link, LinkSettings, Packet, Verdict};

const PERIOD_NS: u64 = 1_000_000;
const SIZE: usize = 92;
const PACKETS: u64 = 1_000_000;
const ROUNDS: usize = 7;

/// Sum over the arrival times, so that any change of a verdict shows.
fn run(settings: &LinkSettings, packets: u64) -> Result<u64, Box<dyn Error>> {
    let mut directions = [Direction::Forward, Direction::Backward].map(|direction| {
        Ok::<_, Box<dyn Error>>((Link::new(direction, 1, settings)?, InFlight::<usize>::growing(1 << 22)))
    });
    let mut sum = 0_u64;
    for index in 0..packets / 2 {
        let now_ns = index * PERIOD_NS;
        for one in &mut directions {
            let (link, in_flight) = one.as_mut().map_err(|error| error.to_string())?;
            while let Some((at_ns, slot)) = in_flight.pop_due(now_ns) {
                sum = sum.wrapping_add(at_ns ^ slot as u64);
            }
            let packet = Packet { direction: link.direction(), sent_ns: now_ns, size: SIZE, index };
            let judgement = link.judge(black_box(&packet));
            if let Verdict::Deliver { at_ns } = judgement.verdict
                && judgement.damage.is_none()
            {
                let _ = in_flight.push(at_ns, usize::try_from(index)?);
            }
            for extra in judgement.extras {
                let _ = in_flight.push(extra.at_ns, usize::try_from(index)?);
            }
        }
    }
    Ok(sum)
}

fn main() -> Result<(), Box<dyn Error>> {
    let delay = LinkSettings { delay_s: 0.05, ..LinkSettings::default() };
    let jitter = LinkSettings { jitter_s: 0.005, ..delay.clone() };
    let links = [
        ("none", LinkSettings::default()),
        ("delay", delay),
        ("jitter", jitter.clone()),
        ("loss", LinkSettings { loss: 0.01, ..LinkSettings::default() }),
        (
            "scattered",
            LinkSettings { loss: 0.01, jitter_correlation_s: Some(0.0), keep_order: false, ..jitter.clone() },
        ),
        ("rough", LinkSettings { loss: 0.01, ..jitter }),
    ];
    let mut arguments = std::env::args().skip(1);
    let (name, packets) = (arguments.next(), arguments.next());
    let rounds = if packets.is_some() { 1 } else { ROUNDS };
    let packets = packets.map_or(Ok(PACKETS), |packets| packets.parse())?;
    if name.as_ref().is_some_and(|name| links.iter().all(|(link, _)| link != name)) {
        return Err(format!("LINK must be one of {}", links.map(|(link, _)| link).join(", ")).into());
    }
    for (link, settings) in links.iter().filter(|(link, _)| name.as_deref().is_none_or(|name| name == *link))
    {
        let (mut least_ns, mut sum) = (f64::INFINITY, 0);
        for _ in 0..rounds {
            let start = Instant::now();
            sum = run(settings, packets)?;
            least_ns = least_ns.min(start.elapsed().as_secs_f64() * 1e9 / packets as f64);
        }
        println!("{link:10} {least_ns:7.1} ns a packet, arrivals {sum:016x}");
    }
    Ok(())
}
