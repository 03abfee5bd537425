//! A press and hold from another program: only an action of a person now counts.
//!
//! The holder sends a beat at least five times a second. Each but the first carries the token answered to the
//! previous one, and all carry the time held. So a stalled queue cannot imitate a hold: its beats lack the token,
//! arrive in a burst, or disagree with the time here.

/// Duration of a press in ns.
const HOLD_NS: u64 = 1_000_000_000;
/// Maximum time between two beats in ns; a longer gap ends the hold.
const MAX_GAP_NS: u64 = 400_000_000;
/// Maximum difference of the sender's time from the time here, in ns.
const MAX_SKEW_NS: u64 = 250_000_000;
/// Minimum number of beats of a hold: five a second.
const MIN_BEATS: u32 = 5;

#[derive(Clone, Copy, Debug)]
pub(super) struct Beat {
    /// Number of its connection.
    pub(super) from: u64,
    /// Arrival time in ns.
    pub(super) now_ns: u64,
    /// Time in ns held so far, as reported.
    pub(super) held_ns: u64,
    /// Token of the previous answer; `None` at first.
    pub(super) token: Option<u64>,
}

/// Result of a beat.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Held {
    /// The hold goes on; carries the token of the next beat.
    Goes(u64),
    /// The hold was long enough and is over: press the clutch.
    Pressed,
    /// The hold is void and over.
    Void(&'static str),
}

#[derive(Clone, Copy, Debug)]
struct Running {
    from: u64,
    began_ns: u64,
    last_ns: u64,
    beats: u32,
}

/// At most one hold at a time.
#[derive(Debug, Default)]
pub(super) struct Hold(Option<Running>);

impl Hold {
    pub(super) fn beat(&mut self, beat: Beat) -> Held {
        let Beat { from, now_ns, held_ns, token } = beat;
        let alive = self.0.filter(|running| now_ns.saturating_sub(running.last_ns) <= MAX_GAP_NS);
        if alive.is_some_and(|running| running.from != from) {
            return Held::Void("another page or program holds the button: it must let go first");
        }
        let before = self.0.take();
        let Some(token) = token else {
            if held_ns > MAX_SKEW_NS {
                return Held::Void(
                    "the hold was under way before its first beat came: let go, and hold again",
                );
            }
            self.0 = Some(Running { from, began_ns: now_ns, last_ns: now_ns, beats: 1 });
            return Held::Goes(now_ns);
        };
        // A lapsed hold of another connection cannot be continued.
        let Some(running) = before.filter(|running| running.from == from && running.last_ns == token) else {
            return Held::Void("the beat answers none that was sent here last: let go, and hold again");
        };
        if now_ns.saturating_sub(running.last_ns) > MAX_GAP_NS {
            return Held::Void("the beats stopped for more than 0.4 s: let go, and hold again");
        }
        let held_here_ns = now_ns.saturating_sub(running.began_ns);
        if held_ns.abs_diff(held_here_ns) > MAX_SKEW_NS {
            return Held::Void("the beats did not arrive as they were sent: let go, and hold again");
        }
        let beats = running.beats + 1;
        if held_here_ns >= HOLD_NS && held_ns >= HOLD_NS {
            return if beats >= MIN_BEATS {
                Held::Pressed
            } else {
                Held::Void("fewer than five beats came in a second: let go, and hold again")
            };
        }
        // Each token is unique, even if the clock stands still.
        let now_ns = now_ns.max(running.last_ns + 1);
        self.0 = Some(Running { last_ns: now_ns, beats, ..running });
        Held::Goes(now_ns)
    }

    /// End the hold of connection `from`.
    pub(super) fn end(&mut self, from: u64) {
        self.0 = self.0.filter(|running| running.from != from);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;
    const START: u64 = 77_000 * MS;

    /// Result of the last beat (arrival in ms, reported time in ms), each with the previous token.
    fn held(beats: &[(u64, u64)]) -> Held {
        let mut hold = Hold::default();
        let mut token = None;
        let mut last = Held::Void("none");
        for (at, says) in beats {
            last = hold.beat(Beat { from: 1, now_ns: START + at * MS, held_ns: says * MS, token });
            token = if let Held::Goes(next) = last { Some(next) } else { token };
        }
        last
    }

    fn even(step: u64) -> Vec<(u64, u64)> {
        (0..=1000 / step).map(|beat| (beat * step, beat * step)).collect()
    }

    #[test]
    fn a_hold_of_a_second_presses_once() {
        assert_eq!(held(&even(100)), Held::Pressed);
        assert_eq!(held(&even(200)), Held::Pressed);
        let short: Vec<_> = even(100).into_iter().filter(|(at, _)| *at < 1000).collect();
        assert!(matches!(held(&short), Held::Goes(_)));
        let beyond: Vec<_> = (0..=11).map(|beat| (beat * 100, beat * 100)).collect();
        assert!(matches!(held(&beyond), Held::Void(_)), "a hold that goes on does not press again");
    }

    #[test]
    fn outdated_beats_are_void() {
        let burst: Vec<_> = (0..=11).map(|beat| (beat, beat * 100)).collect();
        assert!(matches!(held(&burst), Held::Void(_)), "a burst");
        let late: Vec<_> = (0..=5).map(|beat| (beat * 100, beat * 100)).chain([(1000, 600)]).collect();
        assert!(matches!(held(&late), Held::Void(_)), "a gap");
        let slow: Vec<_> = (0..=3).map(|beat| (beat * 350, beat * 350)).collect();
        assert!(matches!(held(&slow), Held::Void(_)), "too few beats");
        let under_way = [(0, 900), (100, 1000)];
        assert!(matches!(held(&under_way), Held::Void(_)), "under way");
        let behind: Vec<_> = (0..=11).map(|beat| (beat * 100, beat * 60)).collect();
        assert!(matches!(held(&behind), Held::Void(_)), "a clock of another speed");
    }

    #[test]
    fn token_is_valid_for_one_beat() {
        let mut hold = Hold::default();
        let mut beat = |after_ms: u64, token| {
            hold.beat(Beat { from: 1, now_ns: START + after_ms * MS, held_ns: after_ms * MS, token })
        };
        let Held::Goes(first) = beat(0, None) else { panic!("it begins") };
        assert!(matches!(beat(100, Some(first)), Held::Goes(_)));
        assert!(matches!(beat(200, Some(first)), Held::Void(_)));
    }

    #[test]
    fn one_hold_at_a_time_until_gap_or_end() {
        let mut hold = Hold::default();
        let first =
            |from, after_ms: u64| Beat { from, now_ns: START + after_ms * MS, held_ns: 0, token: None };
        assert!(matches!(hold.beat(first(1, 0)), Held::Goes(_)));
        assert!(matches!(hold.beat(first(2, 100)), Held::Void(_)));
        let Held::Goes(_) = hold.beat(first(1, 200)) else { panic!("the hold must go on") };
        assert!(matches!(hold.beat(first(2, 601)), Held::Goes(_)), "lapsed");
        hold.end(1);
        assert!(matches!(hold.beat(first(1, 700)), Held::Void(_)), "connection 2 still holds");
        hold.end(2);
        assert!(matches!(hold.beat(first(1, 700)), Held::Goes(_)));
    }
}
