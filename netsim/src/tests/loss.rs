//! Loss models compared with their Markov chains, over a million packets each.

use super::chains::{LossChain, MANY, bursts, check_geometric, lost, two_states};
use crate::{Direction, FourState, GilbertElliott, Link, LinkSettings, Packet};

const MILLISECOND: u64 = 1_000_000;

#[test]
fn bernoulli_loses_independently() {
    for loss in [1e-4, 0.01, 0.3, 0.9] {
        let lost = lost(&LinkSettings { loss, ..LinkSettings::default() }, MILLISECOND, MANY);
        two_states(loss, loss).check_rate(&lost, loss);
        check_geometric(&bursts(&lost), loss);
    }
}

#[test]
fn gilbert_loses_as_much_as_asked_in_bursts_as_long_as_asked() {
    // In the last case a burst starts after each delivered packet.
    for (loss, mean_burst) in [(0.001, 5.0), (0.01, 5.0), (0.05, 10.0), (0.3, 2.0), (0.9, 9.0)] {
        let settings = LinkSettings { loss, mean_burst: Some(mean_burst), ..LinkSettings::default() };
        let lost = lost(&settings, MILLISECOND, MANY);
        let (start, stay) = (loss / (1.0 - loss) / mean_burst, 1.0 - 1.0 / mean_burst);
        let chain = two_states(start, stay);
        // Var = n L (1 - L) (1 + rho) / (1 - rho), rho = stay - start.
        let rho = stay - start;
        let sigma = (MANY as f64 * loss * (1.0 - loss) * (1.0 + rho) / (1.0 - rho)).sqrt();
        assert!((chain.sigma(MANY) - sigma).abs() < 1e-6 * sigma);
        chain.check_rate(&lost, loss);
        check_geometric(&bursts(&lost), stay);
    }
}

#[test]
fn shortest_feasible_burst_is_deterministic() {
    let settings = LinkSettings { loss: 0.5, mean_burst: Some(1.0), ..LinkSettings::default() };
    let lost = lost(&settings, MILLISECOND, 10_000);
    assert!(lost.windows(2).all(|pair| pair[0] != pair[1]), "every second packet");
}

#[test]
fn the_gaps_between_gilbert_bursts_are_geometric_too() {
    let settings = LinkSettings { loss: 0.05, mean_burst: Some(3.0), ..LinkSettings::default() };
    let delivered: Vec<_> = lost(&settings, MILLISECOND, MANY).iter().map(|lost| !lost).collect();
    check_geometric(&bursts(&delivered), 1.0 - 0.05 / 0.95 / 3.0);
}

#[test]
fn a_chain_starts_in_its_stationary_law() {
    let settings = LinkSettings { loss: 0.3, mean_burst: Some(50.0), ..LinkSettings::default() };
    let packet = Packet { direction: Direction::Forward, sent_ns: 0, size: 64, index: 0 };
    let seeds = 20_000;
    let dropped = (0..seeds)
        .filter(|&seed| {
            let mut link = Link::new(Direction::Forward, seed, &settings).unwrap();
            link.judge(&packet);
            link.counters().dropped == 1
        })
        .count() as f64;
    let expected = 0.3 * seeds as f64;
    assert!((dropped - expected).abs() < 3.0 * (expected * 0.7).sqrt(), "{dropped}");
}

#[test]
fn gilbert_in_time_loses_the_same_share_at_any_rate_in_bursts_of_the_same_time() {
    for (loss, mean_burst_s, spacing_ns) in [
        (0.05, 0.005, MILLISECOND),
        (0.05, 0.005, MILLISECOND / 4),
        (0.05, 0.005, 20 * MILLISECOND),
        (0.9, 0.05, MILLISECOND),
        (0.001, 0.02, MILLISECOND),
    ] {
        let settings = LinkSettings { loss, mean_burst_s: Some(mean_burst_s), ..LinkSettings::default() };
        let lost = lost(&settings, spacing_ns, MANY);
        // The process decorrelates as exp(-(1/U + 1/D) t), and 1/U + 1/D = 1 / (D (1 - L)).
        let rho = (-(spacing_ns as f64) * 1e-9 / (mean_burst_s * (1.0 - loss))).exp();
        let (start, stay) = (loss * (1.0 - rho), loss + (1.0 - loss) * rho);
        two_states(start, stay).check_rate(&lost, loss);
        check_geometric(&bursts(&lost), stay);
    }
}

#[test]
fn gilbert_in_time_is_a_function_of_time() {
    let settings = LinkSettings { loss: 0.1, mean_burst_s: Some(0.01), ..LinkSettings::default() };
    let coarse = lost(&settings, 4 * MILLISECOND, 50_000);
    let fine = lost(&settings, MILLISECOND, 200_000);
    assert!(coarse.iter().eq(fine.iter().step_by(4)));
}

#[test]
fn gilbert_elliott_loses_as_its_states_do() {
    for [p, r, good, bad] in [[0.01, 0.1, 0.0, 1.0], [0.02, 0.2, 0.001, 0.5], [1.0, 1.0, 0.2, 0.6]] {
        let model = GilbertElliott { to_bad: p, to_good: r, loss_good: good, loss_bad: bad };
        let settings = LinkSettings { gilbert_elliott: Some(model), ..LinkSettings::default() };
        let chain = LossChain { rows: [[1.0 - p, p], [r, 1.0 - r]], loss: [good, bad] };
        let closed_form = (r * good + p * bad) / (p + r);
        chain.check_rate(&lost(&settings, MILLISECOND, MANY), closed_form);
    }
}

#[test]
fn four_states_lose_packets_in_states_three_and_four() {
    for [p13, p31, p32, p23, p14] in [
        [0.01, 0.2, 0.1, 0.5, 0.005],
        [0.02, 0.98, 0.0, 1.0, 0.0],
        [0.001, 0.01, 0.3, 0.1, 0.02],
        [0.0, 0.5, 0.0, 1.0, 0.05],
    ] {
        let model = FourState { p13, p31, p32, p23, p14 };
        let settings = LinkSettings { four_state: Some(model), ..LinkSettings::default() };
        let rows = [
            [1.0 - p13 - p14, 0.0, p13, p14],
            [0.0, 1.0 - p23, p23, 0.0],
            [p31, p32, 1.0 - p31 - p32, 0.0],
            [1.0, 0.0, 0.0, 0.0],
        ];
        let chain = LossChain { rows, loss: [0.0, 0.0, 1.0, 1.0] };
        // Balance of each cut: pi_3 p31 = pi_1 p13, pi_2 p23 = pi_3 p32, pi_4 = pi_1 p14.
        let third = p13 / p31;
        let closed_form = (third + p14) / (1.0 + third + third * p32 / p23 + p14);
        let lost = lost(&settings, MILLISECOND, MANY);
        chain.check_rate(&lost, closed_form);
        if p13 == 0.0 {
            assert!(bursts(&lost).iter().all(|&length| length == 1));
        }
    }
}

#[test]
fn loss_of_zero_or_one_ignores_bursts() {
    for (loss, expected) in [(0.0, false), (1.0, true)] {
        for (mean_burst, mean_burst_s) in [(None, None), (Some(3.0), None), (None, Some(0.1))] {
            let settings = LinkSettings { loss, mean_burst, mean_burst_s, ..LinkSettings::default() };
            assert!(lost(&settings, MILLISECOND, 1000).iter().all(|&lost| lost == expected));
        }
    }
}
