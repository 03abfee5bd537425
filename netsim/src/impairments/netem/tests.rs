use std::collections::HashMap;

use proptest::prelude::*;

use super::*;
use crate::{Direction, Distribution, Judgement, Link};

const MS: f64 = 1e6;
const COUNT: u64 = 400_000;

fn netem(text: &str) -> LinkSettings {
    LinkSettings { netem: Some(text.into()), ..LinkSettings::default() }
}

/// Verdicts on packets sent at 1 kHz.
fn run<T>(text: &str, count: u64, mut seen: impl FnMut(u64, Judgement<'_>) -> T) -> Vec<T> {
    let direction = Direction::Forward;
    let mut link = Link::new(direction, 3, &netem(text)).unwrap();
    (0..count)
        .map(|index| {
            let packet = Packet { direction, sent_ns: index * 1_000_000, size: 58, index };
            seen(packet.sent_ns, link.judge(&packet))
        })
        .collect()
}

fn delays(text: &str, count: u64) -> Vec<Option<u64>> {
    run(text, count, |sent_ns, judgement| match judgement.verdict {
        Verdict::Deliver { at_ns } => Some(at_ns - sent_ns),
        Verdict::Drop { .. } => None,
    })
}

fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let count = values.clone().count() as f64;
    let mean = values.clone().sum::<f64>() / count;
    let variance = values.map(|value| (value - mean).powi(2)).sum::<f64>() / count;
    (mean, variance.sqrt())
}

fn delay_moments_ms(text: &str) -> (f64, f64) {
    let delays = delays(text, COUNT);
    moments(delays.iter().flatten().map(|&delay_ns| delay_ns as f64 / MS))
}

fn near(seen: f64, expected: f64, within: f64) {
    assert!((seen - expected).abs() < within, "{seen}, expected {expected} +-{within}");
}

/// N(10, 10) truncated at zero: mean `10 (Phi(1) + phi(1))` = 10.833, deviation 8.66.
#[test]
fn negative_delays_become_zero_and_raise_the_mean() {
    let (mean, sigma) = delay_moments_ms("limit 100000 delay 10ms 10ms distribution normal");
    near(mean, 10.833, 4.0 * 8.66 / (COUNT as f64).sqrt() + 0.01);
    near(sigma, 8.66, 0.05);
}

#[test]
fn a_delay_is_uniform_without_a_table_and_as_the_table_with_one() {
    let (mean, sigma) = delay_moments_ms("delay 100ms 10ms");
    near(mean, 100.0, 0.04);
    near(sigma, 10.0 / 3_f64.sqrt(), 0.02);
    // Pareto 20 ms gives about 16 ms.
    let (mean, sigma) = delay_moments_ms("delay 100ms 20ms distribution pareto");
    near(mean, 100.0 - 0.034 * 20.0, 0.12);
    near(sigma, 0.82 * 20.0, 0.25);
}

#[test]
fn no_delay_is_beyond_four_sigma() {
    let delays = delays("delay 100ms 10ms distribution pareto", COUNT);
    let most = delays.iter().flatten().max().unwrap();
    // 32767 / 8192 of 10 ms.
    assert_eq!(*most, 139_998_779);
    let share = delays.iter().filter(|delay| **delay == Some(*most)).count() as f64 / COUNT as f64;
    near(share, 0.01, 0.002);
}

/// sigma of y is that of u times sqrt((1 - rho) / (1 + rho)), its autocorrelation rho.
#[test]
fn correlated_draws_are_narrower() {
    let stream = Stream::new(1, Direction::Forward, Impairment::Netem as u16);
    for (percent, factor) in [(25, 0.77), (50, 0.58), (75, 0.38), (90, 0.23)] {
        let rho = u32::try_from(u64::from(u32::MAX) * percent / 100).unwrap();
        let mut draws = Correlated { rho, last: u32::MAX / 2 };
        let values: Vec<f64> = (0..COUNT)
            .map(|index| f64::from(draws.next(upper(stream.bits(index)))) / 2_f64.powi(32))
            .collect();
        let (mean, sigma) = moments(values.iter().copied());
        near(mean, 0.5, 0.01);
        near(sigma * 12_f64.sqrt(), factor, 0.01);
        let lagged = values.windows(2).map(|pair| (pair[0] - mean) * (pair[1] - mean)).sum::<f64>();
        near(lagged / (COUNT as f64 * sigma * sigma), percent as f64 / 100.0, 0.01);
    }
}

/// The draw is taken modulo 2 J: correlation in 2^32 ns survives only at the maximum J.
#[test]
fn modulo_removes_delay_correlation_unless_the_jitter_is_huge() {
    let lag_1 = |text: &str| {
        let delays: Vec<f64> = delays(text, COUNT).iter().flatten().map(|&ns| ns as f64 / MS).collect();
        let (mean, sigma) = moments(delays.iter().copied());
        let lagged: f64 = delays.windows(2).map(|pair| (pair[0] - mean) * (pair[1] - mean)).sum();
        (sigma, lagged / (COUNT as f64 * sigma * sigma))
    };
    for law in ["", "distribution normal"] {
        let (alone, _) = lag_1(&format!("delay 100ms 10ms {law}"));
        let (sigma, correlation) = lag_1(&format!("delay 100ms 10ms 75% {law}"));
        near(sigma / alone, 1.0, 0.01);
        near(correlation, 0.0, 0.01);
    }
    let (sigma, correlation) = lag_1("limit 1000000 delay 10s 2147483647ns 75%");
    near(sigma / (2147.5 / 3_f64.sqrt()), 0.378, 0.01);
    near(correlation, 0.75, 0.01);
}

fn loss(text: &str, count: u64) -> f64 {
    delays(text, count).iter().filter(|delay| delay.is_none()).count() as f64 / count as f64
}

/// A correlated draw rarely comes near zero; values in per cent.
#[test]
fn correlated_loss_almost_vanishes() {
    const DRAWS: u64 = 2_000_000;
    for (text, expected, within) in [
        ("loss 1%", 1.0, 0.03),
        ("loss 1% 25%", 0.0003, 0.0003),
        ("loss 5% 25%", 0.19, 0.02),
        ("loss 10% 50%", 0.10, 0.02),
        ("loss 0.3% 25%", 0.0, 0.0001),
    ] {
        near(100.0 * loss(text, DRAWS), expected, within);
    }
}

#[test]
fn loss_models_match_their_chains() {
    // Gilbert-Elliott: bad p / (p + r) of the time. Bernoulli with the default r. Four states with p14 only:
    // one in 1 + 1 / p14 packets.
    near(loss("loss gemodel 1% 10% 70% 0.1%", COUNT), 0.7 / 11.0 + 0.01 / 11.0, 0.004);
    near(loss("loss gemodel 4%", COUNT), 0.04, 0.002);
    near(loss("loss state 1% 25%", COUNT), 0.01 / 0.26, 0.003);
    near(loss("loss state 0% 100% 0% 0% 10%", COUNT), 1.0 / 11.0, 0.003);
    // Within a burst, p32 and p23: ratios 1 : p13 p32 / (p31 p23) : p13 / p31.
    near(loss("loss state 5% 20% 30% 60%", COUNT), 0.25 / (1.0 + 0.125 + 0.25), 0.008);
}

/// Packets that arrive after a packet sent later (RFC 4737).
fn reordered(text: &str) -> f64 {
    let mut arrivals: Vec<(u64, u64)> = delays(text, COUNT)
        .iter()
        .zip(0..)
        .filter_map(|(delay_ns, index)| delay_ns.map(|delay_ns| (index * 1_000_000 + delay_ns, index)))
        .collect();
    arrivals.sort_unstable();
    let mut latest = 0;
    let late = arrivals.iter().filter(|&&(_, index)| {
        latest = latest.max(index);
        index < latest
    });
    late.count() as f64 / COUNT as f64
}

#[test]
fn jitter_reorders_unless_there_is_a_rate() {
    for (sigma, expected) in [("0.5ms", 0.08), ("1ms", 0.27), ("5ms", 0.72), ("10ms", 0.83)] {
        let text = format!("delay 50ms {sigma} distribution normal");
        near(reordered(&text), expected, 0.012);
        assert_eq!(reordered(&format!("{text} rate 100mbit")), 0.0);
    }
}

/// The wait for the line is part of the delay. 100 bytes take 0.5 ms at 1.6 Mbit/s, less than the spacing, so
/// no packet waits. At 0.4 Mbit/s they take 2 ms, and each packet leaves 2 ms after the previous one.
#[test]
fn a_rate_makes_packets_leave_one_after_the_other() {
    let fast = delays("delay 10ms rate 1.6mbit", 100);
    assert!(fast.iter().all(|delay| *delay == Some(10_500_000)));
    let slow = delays("delay 10ms rate 400kbit", 5);
    let expected = [12, 13, 14, 15, 16].map(|ms| Some(ms * 1_000_000));
    assert_eq!(slow, expected);
    // Three cells of 48 + 5 bytes.
    assert_eq!(delays("rate 1mbps 0 48 5", 1), [Some(159_000)]);
    assert_eq!(delays("rate 1mbps -20", 1), [Some(80_000)]);
}

#[test]
fn more_than_the_limit_is_dropped() {
    assert_eq!(loss("delay 900ms", 5000), 0.0);
    let delays = delays("delay 2s", 3000);
    let passed = |range: std::ops::Range<usize>| delays[range].iter().flatten().count();
    assert_eq!((passed(0..1000), passed(1000..2000), passed(2000..3000)), (1000, 0, 1000));
}

#[test]
fn reordered_packets_are_sent_at_once() {
    let delays = delays("delay 10ms reorder 25%", COUNT);
    let at_once = delays.iter().filter(|delay| **delay == Some(0)).count() as f64 / COUNT as f64;
    near(at_once, 0.25, 0.004);
    assert!(delays.iter().all(|delay| matches!(delay, Some(0 | 10_000_000))));
    let fifth = super::tests::delays("delay 10ms reorder 100% gap 5", 20);
    let at_once: Vec<usize> = (0..20).filter(|&index| fifth[index] == Some(0)).collect();
    assert_eq!(at_once, [4, 9, 14, 19]);
}

#[test]
fn copies_and_damage_have_draws_of_their_own() {
    let mut counts: HashMap<&str, u64> = HashMap::new();
    run("delay 10ms 5ms loss 20% duplicate 30% corrupt 10%", COUNT, |sent_ns, judgement| {
        let mut count = |name, occurs| *counts.entry(name).or_default() += u64::from(occurs);
        let arrives = matches!(judgement.verdict, Verdict::Deliver { .. });
        count("arrives", arrives);
        count("damaged", arrives && judgement.damage.corrupts());
        if let [copy] = judgement.extras {
            count("copies", true);
            count("damaged copies", copy.damage.corrupts());
            let later = matches!(judgement.verdict, Verdict::Deliver { at_ns } if at_ns != copy.at_ns);
            count("apart", later);
            assert!(copy.at_ns >= sent_ns && copy.cause == ExtraCause::Duplicate);
            let mut bytes = [0; 58];
            copy.damage.apply(&mut bytes);
            let flipped: u32 = bytes.iter().map(|byte| byte.count_ones()).sum();
            assert_eq!(flipped, u32::from(copy.damage.corrupts()));
        }
    });
    // Lost and not duplicated; duplicated, not lost, and the copy not lost.
    for (name, expected) in [
        ("arrives", 1.0 - 0.2 * 0.7),
        ("damaged", 0.1 * (1.0 - 0.2 * 0.7)),
        ("copies", 0.3 * 0.8 * 0.8),
        ("damaged copies", 0.1 * 0.3 * 0.8 * 0.8),
        ("apart", 0.3 * 0.8 * 0.8),
    ] {
        near(counts[name] as f64 / COUNT as f64, expected, 0.004);
    }
}

#[test]
fn one_option_shifts_no_draw_of_another() {
    let plain = delays("delay 50ms 5ms loss 5%", 10_000);
    let more = delays("delay 50ms 5ms loss 5% corrupt 20% duplicate 0.001%", 10_000);
    assert_eq!(plain, more);
}

#[test]
fn verdicts_are_the_same_on_every_platform() {
    let seen = delays("delay 50ms 5ms 25% distribution paretonormal loss 20% 10% reorder 20%", 10);
    let expected = [0, 49_364_014, 0, 0, 67_896_729, 57_131_958, 0, 0, 52_821_045, 45_161_133].map(Some);
    assert_eq!(seen, expected);
}

#[test]
fn arguments_are_read_as_tc_reads_them() {
    let read = |text| Arguments::read(text).unwrap();
    let short =
        read("del 100ms 10ms 25% dist normal lo 1 25 dup 1% reorder 2% 50% gap 5 limit 200 rate 1mbit 20");
    assert_eq!(
        short,
        read(
            "tc qdisc add dev eth0 root handle 1: netem limit 200 rate 125kbps 20 gap 5 \
        reorder 2% 50% duplicate 1% loss random 1% 25% latency 100000 10000us 25% distribution normal"
        )
    );
    assert_eq!(
        (short.latency_ns, short.jitter_ns, short.limit, short.gap),
        (100_000_000, 10_000_000, 200, 5)
    );
    assert_eq!(short.rate.map(|rate| (rate.bytes_per_s, rate.overhead)), Some((125_000, 20)));
    let half = u32::MAX / 2 + 1;
    assert_eq!(short.reorder.rho, half);
    assert_eq!(read("netem").limit, 1000);
    assert_eq!(read("").loss, Loss::Random(Chance { probability: 0, rho: 0 }));
    assert_eq!(read("delay 1s 3s").jitter_ns, i64::from(i32::MAX));
}

/// Lines as printed by `tc qdisc show` of iproute2, and the arguments that produced them.
#[test]
fn a_line_of_tc_qdisc_show_is_read_as_the_arguments_that_made_it() {
    let cases = [
        ("limit 1000 delay 50ms  10ms 25% loss 1% 25%", "delay 50ms 10ms 25% loss 1% 25%"),
        ("limit 1000 delay 100ms seed 13237219379021", "delay 100ms"),
        (
            "limit 200 delay 5ms loss state p13 1% p31 99% p32 0% p23 100% p14 0% ecn",
            "limit 200 delay 5ms loss state 1% 99% 0% 100% 0%",
        ),
        ("limit 9 loss gemodel p 1% r 10% 1-h 70% 1-k 0.1%", "limit 9 loss gemodel 1% 10% 70% 0.1%"),
        (
            "limit 1000 delay 10ms duplicate 1% reorder 25% 50% corrupt 0.1% gap 5",
            "delay 10ms duplicate 1% reorder 25% 50% corrupt 0.1% gap 5",
        ),
        ("limit 1000 rate 1Mbit packetoverhead 20 cellsize 100 celloverhead 5", "rate 1mbit 20 100 5"),
    ];
    let before = [
        "qdisc netem 8001: root refcnt 2 ",
        "qdisc netem 8001: dev eth0 root refcnt 2 ",
        "qdisc netem 10: dev eth0 parent 1:1 ",
        "qdisc netem 8001: dev eth0 root offloaded refcnt 2 ",
        "qdisc noqueue 0: dev lo root refcnt 2\nqdisc netem 8001: dev eth0 root refcnt 2 ",
    ];
    let after = [
        "",
        "\n",
        "\n Sent 98 bytes 1 pkt (dropped 0, overlimits 0 requeues 0)\n backlog 0b 0p requeues 0\n",
    ];
    for (shown, made) in cases {
        for (before, after) in before.iter().flat_map(|before| after.iter().map(move |after| (before, after)))
        {
            let text = format!("{before}{shown}{after}");
            assert_eq!(Arguments::read(&text), Arguments::read(made), "{text}");
        }
    }
}

#[test]
fn an_error_says_where_in_the_text_it_is() {
    let cases = [
        ("delay", "netem: column 6: delay is missing"),
        ("delay 10xs", "netem: column 7: delay = \"10xs\": must be a number"),
        ("loss 101%", "netem: column 6: loss = \"101%\""),
        ("loss 1% loss 2%", "netem: column 9: a second loss"),
        ("speed 3", "netem: column 1: \"speed\" is no option; there are limit, latency"),
        ("delay 10ms 1ms distribution experimental", "netem: column 29: distribution experimental"),
        ("delay 10ms distribution normal", "netem: column 31: distribution needs delay and jitter"),
        ("reorder 3%", "netem: column 11: reorder needs a delay"),
        ("delay 1ms gap 3", "netem: column 16: gap needs"),
        ("slot 20ms", "netem: column 1: slot is not reproduced"),
        ("seed 4", "netem: column 1: seed"),
        ("ecn", "netem: column 1: ecn needs a loss"),
        ("limit -1", "netem: column 7: limit = \"-1\""),
        ("rate 1mbit 0 10 -10", "netem: column 17: a cell"),
        ("tc qdisc add dev eth0 root pfifo", "netem: column 33: a tc command without"),
    ];
    for (text, expected) in cases {
        let message = netem(text).validate().unwrap_err().to_string();
        assert!(message.starts_with(expected), "{message}");
    }
    let beside = LinkSettings { loss: 0.1, ..netem("delay 1ms") };
    assert!(beside.validate().unwrap_err().to_string().starts_with("netem: nothing else"));
}

#[test]
fn netem_arguments_are_translated_to_link_settings() {
    let plain = LinkSettings { delay_s: 0.1, ..LinkSettings::default() };
    let cases = [
        ("delay 100ms", plain.clone()),
        (
            "delay 100ms 10ms distribution normal",
            LinkSettings { jitter_s: 0.01, jitter_correlation_s: Some(0.0), ..plain.clone() },
        ),
        (
            "delay 100ms 30ms 25%",
            LinkSettings {
                jitter_s: 0.03 / 3_f64.sqrt(),
                distribution: Distribution::Uniform,
                ..plain.clone()
            },
        ),
        (
            "loss 5% 50% delay 100ms",
            LinkSettings { loss: 0.05, mean_burst: Some(1.0 / 0.475), ..plain.clone() },
        ),
        (
            "delay 100ms reorder 20% gap 4 duplicate 3% corrupt 1%",
            LinkSettings { reorder: 0.05, duplicate: 0.03, corrupt: 0.01, ..plain },
        ),
        (
            "rate 1mbit 10 limit 50",
            LinkSettings {
                rate_bps: Some(1e6),
                overhead_bytes: 52,
                queue_packets: Some(50),
                ..LinkSettings::default()
            },
        ),
    ];
    for (text, expected) in cases {
        assert_eq!(translate(text), Ok(expected), "{text}");
    }
    let chain = translate("loss gemodel 1% 10% 70% 0.1%").unwrap().gilbert_elliott.unwrap();
    assert_eq!((chain.to_bad, chain.to_good, chain.loss_bad, chain.loss_good), (0.01, 0.1, 0.7, 0.001));
    assert!(translate("rate 1mbit 0 48 5").is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(4000))]

    #[test]
    fn no_text_breaks_the_reader(
        words in prop::collection::vec(
            prop_oneof![
                "[a-z]{1,8}",
                "-?[0-9.]{1,12}(ms|%|us|mbit|s|)",
                prop::sample::select(arguments::OPTIONS.as_slice()).prop_map(String::from),
                "\\PC{0,4}",
            ],
            0..12,
        ),
    ) {
        let text = words.join(" ");
        if let Err(error) = netem(&text).validate() {
            prop_assert!(error.to_string().starts_with("netem: column "), "{}", error);
        }
    }
}

#[test]
fn correlations_and_limit_are_read() {
    let asked =
        Asked::read("delay 50ms 10ms 25% loss 1% 50% corrupt 1% 75% duplicate 2% 5% reorder 1% 90% limit 7");
    let expected = Asked { delay: 0.25, loss: 0.5, duplicate: 0.05, corrupt: 0.75, reorder: 0.9, limit: 7 };
    assert_eq!(asked, Ok(expected));
    let none = Asked { delay: 0.0, loss: 0.0, duplicate: 0.0, corrupt: 0.0, reorder: 0.0, limit: 1000 };
    assert_eq!(Asked::read("loss gemodel 1% 10%"), Ok(none));
    assert!(Asked::read("nonsense").is_err());
}

#[test]
fn settings_are_read_back_as_they_were_written() {
    for text in [
        "delay 50ms 10ms 25% loss 1% 25%",
        "delay 50ms 10ms distribution paretonormal loss state 1% 25% rate 1mbit",
        "delay 50ms 10ms distribution pareto loss gemodel 1% 10% 70% 0.1% reorder 5% corrupt 1%",
    ] {
        let settings = translate(text).unwrap();
        let written = serde_json::to_string(&settings).unwrap();
        assert_eq!(serde_json::from_str::<LinkSettings>(&written).unwrap(), settings);
    }
}
