//! The secure session between honest sides, over a network that loses, delays, reorders and repeats.
#![allow(clippy::unwrap_used)] // a test may

use crate::pair::{MS, Numbers, PAYLOAD, Pair, end, key, number, payload, peer, settings};
use haptether_bridge::{
    session::{
        Arrival, HANDSHAKE_LENGTH, HandshakeDecision, HandshakeEvent, MAX_DATAGRAM, Received, Rejection,
        SealError, Session, SessionEnd, SessionEvent, SessionSettings, sealed_length,
    },
    wire::{FrameForm, Role},
};
use proptest::prelude::*;

const SECOND: u64 = 1000 * MS;

/// Both implementations would apply to a session that can be cloned, and the constant below would be ambiguous.
trait NotClone<Marker> {
    const HOLDS: () = ();
}
impl<T> NotClone<()> for T {}
impl<T: Clone> NotClone<u8> for T {}
const _: () = <Session as NotClone<_>>::HOLDS;

fn epochs(end: &mut SessionEnd) -> Vec<SessionEvent> {
    std::iter::from_fn(|| end.session.poll_event()).collect()
}

fn is_hello(datagram: &[u8]) -> bool {
    datagram.len() == HANDSHAKE_LENGTH && datagram[3] == 1
}

fn is_answer(datagram: &[u8]) -> bool {
    datagram.len() == HANDSHAKE_LENGTH && datagram[3] == 2
}

#[test]
fn a_round_trip_after_one_round_trip() {
    let mut pair = Pair::new();
    pair.run(60);
    assert_eq!(pair.rejected, []);
    // Hello at 1 ms, answer from 6 ms, the first frame of the master at 11 ms, that of the slave at 16 ms.
    assert_eq!(pair.taken_at(Role::Slave)[..3], [11 * MS, 12 * MS, 13 * MS]);
    assert_eq!(pair.taken_at(Role::Master)[..3], [16 * MS, 17 * MS, 18 * MS]);
    assert!(pair.master.session.is_secure() && pair.slave.session.is_secure());
    let session = pair.master.session.session().unwrap();
    assert_eq!(epochs(&mut pair.master), [SessionEvent::Began { session }]);
    assert_eq!(epochs(&mut pair.slave), [SessionEvent::Began { session }]);
    for (_, _, datagram) in &pair.sent {
        let is_handshake = is_hello(datagram) || is_answer(datagram);
        assert_eq!(datagram.len(), if is_handshake { HANDSHAKE_LENGTH } else { sealed_length(PAYLOAD) });
    }
    assert_eq!(pair.sent.iter().filter(|(.., datagram)| datagram.len() == HANDSHAKE_LENGTH).count(), 2);
}

#[test]
fn plaintext_only_by_name() {
    let mut master = SessionEnd::insecure(settings(Role::Master)).unwrap();
    let mut slave = SessionEnd::insecure(settings(Role::Slave)).unwrap();
    assert!(!master.session.is_secure());
    let mut buffer = [0; MAX_DATAGRAM];
    let mut datagram = master.session.seal(0, &payload(7), &mut buffer).unwrap().to_vec();
    assert_eq!(datagram, payload(7));
    assert_eq!(
        slave.receive(0, &mut datagram, &mut Numbers(0)),
        Ok(Received::Payload { payload: &payload(7), arrival: Arrival::Newer })
    );
    assert_eq!(slave.receive(0, &mut [0; 5], &mut Numbers(0)), Err(Rejection::Length));
    assert_eq!(slave.poll(0, &mut Numbers(0)), Ok(None));
    // A secure side takes no plaintext, and an insecure one no sealed datagram.
    let mut pair = Pair::opened();
    assert_eq!(pair.slave.receive(pair.now_ns, &mut payload(7), &mut Numbers(0)), Err(Rejection::Length));
    let mut sealed = pair.master.session.seal(pair.now_ns, &payload(7), &mut buffer).unwrap().to_vec();
    assert_eq!(slave.receive(0, &mut sealed, &mut Numbers(0)), Err(Rejection::Length));
}

#[test]
fn nothing_is_sealed_before_the_handshake() {
    let mut pair = Pair::new();
    assert_eq!(pair.send(Role::Master, 1), Err(SealError::NoSession));
    assert_eq!(pair.send(Role::Slave, 1), Err(SealError::NoSession));
    let mut buffer = [0; MAX_DATAGRAM];
    assert_eq!(pair.master.session.release(0, &mut buffer), Err(SealError::NoSession));
    let mut open = Pair::opened();
    assert_eq!(
        open.master.session.seal(open.now_ns, &[0; 5], &mut buffer),
        Err(SealError::Length { seen: 5, allowed: PAYLOAD })
    );
}

/// Each handshake message lost, up to the fourth: the next repeat does it.
#[test]
fn a_lost_handshake_message_is_sent_again() {
    for lost in 0..4 {
        for which in [is_hello as fn(&[u8]) -> bool, is_answer] {
            let mut pair = Pair::new();
            let mut left = lost;
            pair.fate = Box::new(move |_, _, datagram| {
                if which(datagram) && left > 0 {
                    left -= 1;
                    return vec![];
                }
                vec![5 * MS]
            });
            pair.run(4500);
            let hellos: Vec<_> =
                pair.sent.iter().filter(|(.., bytes)| is_hello(bytes)).map(|(at, ..)| at / MS).collect();
            assert_eq!(hellos, [1, 251, 751, 1751, 3751][..=lost]);
            assert!(pair.taken_at(Role::Master).len() > 500);
            assert_eq!(pair.rejected, []);
        }
    }
}

/// A round trip of 2 s, longer than the first waits: repeats are the same message, so the first answer does it.
#[test]
fn a_round_trip_longer_than_the_retry_needs_one_handshake() {
    let mut pair = Pair::new();
    pair.fate = Box::new(|_, _, _| vec![SECOND]);
    pair.run(4100);
    assert_eq!(pair.taken_at(Role::Slave)[0], 2001 * MS);
    let mut hellos: Vec<_> = pair.sent.iter().filter(|(.., bytes)| is_hello(bytes)).collect();
    assert_eq!(hellos.len(), 4);
    hellos.dedup_by(|one, other| one.2 == other.2);
    assert_eq!(hellos.len(), 1);
}

/// The first frames under new keys get lost: the slave learns of them from the next.
#[test]
fn new_keys_are_confirmed_by_whatever_frame_arrives_first() {
    let mut pair = Pair::new();
    pair.fate = Box::new(|at, to, bytes| {
        let lost = to == Role::Slave && bytes.len() != HANDSHAKE_LENGTH && at < 300 * MS;
        if lost { vec![] } else { vec![5 * MS] }
    });
    pair.run(400);
    assert_eq!(pair.taken_at(Role::Slave)[0], 300 * MS);
    assert_eq!(pair.rejected, []);
}

/// Fast rekeying, so that epochs overlap often.
fn hasty(role: Role) -> SessionSettings {
    SessionSettings { rekey_ns: 400 * MS, refuse_ns: 8000 * MS, overlap_ns: 200 * MS, ..settings(role) }
}

#[test]
fn rekeying_loses_nothing_however_frames_overtake() {
    let mut pair = Pair::with(hasty(Role::Master), hasty(Role::Slave));
    let mut numbers = Numbers(9);
    pair.fate = Box::new(move |_, _, _| vec![MS + numbers.draw() % (100 * MS)]);
    pair.run(5000);
    for _ in 0..150 {
        pair.tick(false);
    }
    assert_eq!(pair.rejected, []);
    for role in [Role::Master, Role::Slave] {
        let sent =
            pair.sent.iter().filter(|(_, to, bytes)| *to == role && bytes.len() != HANDSHAKE_LENGTH).count();
        let mut taken = pair.taken_at(role);
        assert_eq!(taken.len(), sent);
        let newer: Vec<_> = pair
            .taken
            .iter()
            .filter(|(at, _, arrival)| *at == role && *arrival == Arrival::Newer)
            .map(|(_, number, _)| *number)
            .collect();
        assert!(newer.is_sorted(), "strictly newer, over the change of keys too");
        assert!(newer.len() < taken.len());
        taken.sort_unstable();
        taken.dedup();
        assert_eq!(taken.len(), sent);
        let events = epochs(pair.end(role));
        assert!(matches!(events[0], SessionEvent::Began { .. }));
        assert!(events.len() >= 8, "{events:?}");
        for (n, event) in events.iter().enumerate().skip(1) {
            assert_eq!(*event, SessionEvent::Rekeyed { epoch: u32::try_from(n).unwrap() });
        }
    }
}

/// A network that also loses and repeats: sessions live on over every change of keys.
#[test]
fn rekeying_survives_loss_and_copies() {
    let mut pair = Pair::with(hasty(Role::Master), hasty(Role::Slave));
    let mut numbers = Numbers(10);
    pair.fate = Box::new(move |_, _, _| {
        let copies = [0, 1, 1, 1, 1, 1, 2][(numbers.draw() % 7) as usize];
        (0..copies).map(|_| MS + numbers.draw() % (100 * MS)).collect()
    });
    pair.run(20_000);
    let session = pair.master.session.session();
    assert_eq!(pair.slave.session.session(), session);
    let (of_master, of_slave) = (epochs(&mut pair.master), epochs(&mut pair.slave));
    assert_eq!(of_master.iter().filter(|e| matches!(e, SessionEvent::Began { .. })).count(), 1);
    assert!(of_slave.len() >= 20, "{of_slave:?}");
    for (_, rejection) in &pair.rejected {
        assert!(
            matches!(rejection, Rejection::Repeated | Rejection::Replayed | Rejection::Unexpected),
            "{rejection}"
        );
    }
}

#[test]
fn both_sides_asking_at_once_get_one_set_of_keys() {
    let mut pair = Pair::opened();
    epochs(&mut pair.master);
    epochs(&mut pair.slave);
    pair.master.session.rekey();
    pair.slave.session.rekey();
    pair.run(200);
    assert_eq!(epochs(&mut pair.master), [SessionEvent::Rekeyed { epoch: 1 }]);
    assert_eq!(epochs(&mut pair.slave), [SessionEvent::Rekeyed { epoch: 1 }]);
    // The slave alone can ask as well.
    pair.slave.session.rekey();
    pair.run(200);
    assert_eq!(epochs(&mut pair.master), [SessionEvent::Rekeyed { epoch: 2 }]);
    assert_eq!(epochs(&mut pair.slave), [SessionEvent::Rekeyed { epoch: 2 }]);
    assert_eq!(pair.rejected, []);
}

#[test]
fn rekeying_comes_at_120_s_and_without_it_sending_ends_at_180_s() {
    let mut pair = Pair::opened();
    epochs(&mut pair.master);
    pair.now_ns = 119_990 * MS;
    pair.run(5);
    pair.now_ns = 119_999 * MS;
    let before = pair.sent.len();
    pair.run(40);
    assert!(pair.sent[before..].iter().any(|(.., bytes)| is_hello(bytes)));
    assert_eq!(epochs(&mut pair.master), [SessionEvent::Rekeyed { epoch: 1 }]);

    let mut alone = Pair::opened();
    alone.fate = Box::new(|_, _, bytes| if bytes.len() == HANDSHAKE_LENGTH { vec![] } else { vec![5 * MS] });
    for now_ns in (60 * MS..190 * SECOND).step_by(500_000_000) {
        alone.now_ns = now_ns;
        alone.run(2);
    }
    for role in [Role::Master, Role::Slave] {
        let last = alone.taken_at(role).into_iter().max().unwrap();
        assert!((179 * SECOND..=180 * SECOND + 20 * MS).contains(&last), "{last}");
        assert!(matches!(epochs(alone.end(role)).last(), Some(SessionEvent::Expired)));
    }
}

/// 60 s before the keys open nothing more, once, at both sides; never where they are renewed.
#[test]
fn people_are_warned_60_s_before_the_keys_end() {
    for renews in [false, true] {
        let mut pair = Pair::opened();
        pair.fate = Box::new(
            move |_, _, bytes| {
                if bytes.len() == HANDSHAKE_LENGTH && !renews { vec![] } else { vec![5 * MS] }
            },
        );
        for role in [Role::Master, Role::Slave] {
            epochs(pair.end(role));
        }
        let mut warned = Vec::new();
        for at_ms in (100..130_000).step_by(20) {
            pair.now_ns = at_ms * MS;
            pair.run(12);
            for role in [Role::Master, Role::Slave] {
                for event in epochs(pair.end(role)) {
                    if let SessionEvent::Aging { left_ns } = event {
                        warned.push((role, at_ms / 1000, left_ns / SECOND));
                    }
                }
            }
        }
        warned.sort_by_key(|(role, ..)| *role == Role::Slave);
        let expected = [(Role::Master, 125, 55), (Role::Slave, 125, 55)];
        assert_eq!(warned, if renews { &[][..] } else { &expected[..] });
    }
}

/// No handshake gets through until the keys have grown too old: the same two ends go on without a person, another
/// master does not.
#[test]
fn the_holder_goes_on_after_its_keys_have_grown_too_old() {
    let mut pair = Pair::with(hasty(Role::Master), hasty(Role::Slave));
    pair.fate = Box::new(|at, _, bytes| {
        let lost = bytes.len() == HANDSHAKE_LENGTH && (100 * MS..20 * SECOND).contains(&at);
        if lost { vec![] } else { vec![5 * MS] }
    });
    pair.run(12_000);
    let session = epochs(&mut pair.slave);
    assert!(matches!(
        session[..],
        [SessionEvent::Began { .. }, SessionEvent::Aging { .. }, SessionEvent::Expired]
    ));
    assert!(!pair.master.session.is_open(pair.now_ns) && !pair.slave.session.is_open(pair.now_ns));
    assert!(pair.slave.session.is_leased());
    let mut second = end(settings(Role::Master), key(), 55);
    let mut entropy = Numbers(56);
    let mut hello = second.poll(0, &mut entropy).unwrap().unwrap();
    let Ok(Received::Reply(mut answer)) = pair.slave.receive(pair.now_ns, &mut hello, &mut entropy) else {
        panic!("an authentic hello is answered");
    };
    second.receive(10, &mut answer, &mut entropy).unwrap();
    assert!(matches!(
        second.poll_event(),
        Some(HandshakeEvent::Refused { decision: HandshakeDecision::Leased, .. })
    ));
    pair.run(20_000);
    assert!(pair.master.session.is_open(pair.now_ns) && pair.slave.session.is_open(pair.now_ns));
    assert!(matches!(epochs(&mut pair.slave)[0], SessionEvent::Rekeyed { .. }));
    assert!(pair.taken_at(Role::Master).last() > Some(&(31 * SECOND)));
    assert_eq!((pair.master.poll_event(), pair.slave.poll_event()), (None, None));
}

/// After the keys have grown too old, the slave restarts, or a person there lets another master begin.
#[test]
fn a_slave_that_forgot_the_session_gets_a_new_one_after_the_keys_grew_too_old() {
    for restarts in [true, false] {
        let mut pair = Pair::with(hasty(Role::Master), hasty(Role::Slave));
        pair.fate = Box::new(|at, _, bytes| {
            let lost = bytes.len() == HANDSHAKE_LENGTH && (100 * MS..12 * SECOND).contains(&at);
            if lost { vec![] } else { vec![5 * MS] }
        });
        pair.run(11_000);
        if restarts {
            pair.slave = end(hasty(Role::Slave), key(), 77);
        } else {
            epochs(&mut pair.slave);
            pair.slave.session.allow_takeover(pair.now_ns).unwrap();
            assert_eq!(epochs(&mut pair.slave), [SessionEvent::TakenOver]);
        }
        pair.run(20_000);
        assert!(pair.master.session.is_open(pair.now_ns) && pair.slave.session.is_open(pair.now_ns));
        assert!(matches!(epochs(&mut pair.slave)[0], SessionEvent::Began { .. }));
    }
}

/// While its frames were lost, a person at the slave let another master begin: the first is notified, though it has
/// keys.
#[test]
fn a_master_whose_lease_was_taken_over_is_notified() {
    let mut pair = Pair::opened();
    let mut second = end(settings(Role::Master), key(), 55);
    let mut entropy = Numbers(56);
    pair.now_ns = 5000 * MS;
    let now_ns = pair.now_ns;
    pair.slave.session.allow_takeover(now_ns).unwrap();
    let mut hello = second.poll(now_ns, &mut entropy).unwrap().unwrap();
    let Ok(Received::Reply(mut answer)) = pair.slave.receive(now_ns, &mut hello, &mut entropy) else {
        panic!()
    };
    second.receive(now_ns, &mut answer, &mut entropy).unwrap();
    let mut buffer = [0; MAX_DATAGRAM];
    let mut frame = second.session.seal(now_ns, &payload(1), &mut buffer).unwrap().to_vec();
    pair.slave.receive(now_ns, &mut frame, &mut entropy).unwrap();
    // The slave seals for the second, which this master cannot open.
    pair.run(12_000);
    let event = pair.master.poll_event();
    assert!(
        matches!(event, Some(HandshakeEvent::Refused { decision: HandshakeDecision::Leased, .. })),
        "{event:?}"
    );
    assert_eq!(pair.slave.session.session(), second.session.session());
}

#[test]
fn a_used_up_counter_refuses_to_send() {
    let few = |role| SessionSettings { max_sealed: 20, ..settings(role) };
    let mut pair = Pair::with(few(Role::Master), few(Role::Slave));
    pair.run(100);
    assert_eq!(pair.taken_at(Role::Slave).len(), 20);
    let error = pair.send(Role::Master, 1).unwrap_err();
    assert!(matches!(error, SealError::UsedUp { sealed: 20, .. }), "{error}");
    assert!(!pair.master.session.is_open(pair.now_ns));
}

#[test]
fn a_slave_that_restarts_gets_a_new_session() {
    let mut pair = Pair::opened();
    let before = pair.master.session.session();
    pair.slave = end(settings(Role::Slave), key(), 77);
    pair.run(1900);
    assert_eq!(pair.master.session.session(), before, "silence is not yet long enough");
    assert!(pair.rejected.iter().all(|what| *what == (Role::Slave, Rejection::Session)));
    pair.run(300);
    let after = pair.master.session.session();
    assert!(after.is_some() && after != before);
    assert_eq!(pair.slave.session.session(), after);
    let events = epochs(&mut pair.master);
    assert!(matches!(events[..], [SessionEvent::Began { .. }, SessionEvent::Began { .. }]), "{events:?}");
}

#[test]
fn a_master_that_restarts_waits_for_a_person_at_the_slave() {
    let mut pair = Pair::opened();
    let before = pair.slave.session.session();
    pair.master = end(settings(Role::Master), key(), 77);
    let error = pair.slave.session.allow_takeover(pair.now_ns).unwrap_err();
    assert_eq!(error.silence_ns, 2 * SECOND);
    pair.run(5000);
    assert_eq!(pair.slave.session.session(), before);
    assert!(pair.slave.session.is_leased());
    assert!(matches!(
        pair.master.poll_event(),
        Some(HandshakeEvent::Refused { decision: HandshakeDecision::Leased, .. })
    ));
    assert!(matches!(pair.slave.poll_event(), Some(HandshakeEvent::SecondMaster { .. })));
    // One hello a second, answered each, and no more than that.
    let hellos = pair.sent.iter().filter(|(.., bytes)| is_hello(bytes)).count();
    assert!((4..=7).contains(&hellos), "{hellos}");
    pair.slave.session.allow_takeover(pair.now_ns).unwrap();
    assert_eq!(epochs(&mut pair.slave).last(), Some(&SessionEvent::TakenOver));
    pair.run(1200);
    assert!(pair.slave.session.session().is_some() && pair.slave.session.session() != before);
    assert_eq!(pair.slave.session.session(), pair.master.session.session());
}

#[test]
fn a_master_that_takes_leave_makes_room_at_once() {
    let mut pair = Pair::opened();
    let mut buffer = [0; MAX_DATAGRAM];
    for _ in 0..3 {
        let release = pair.master.session.release(pair.now_ns, &mut buffer).unwrap().to_vec();
        assert_eq!(release.len(), sealed_length(PAYLOAD));
        pair.carry(Role::Slave, &release);
    }
    pair.master = end(settings(Role::Master), key(), 77);
    pair.run(100);
    let events = epochs(&mut pair.slave);
    assert_eq!(events[1], SessionEvent::Released);
    assert!(matches!(events[2], SessionEvent::Began { .. }));
    assert!(pair.rejected.iter().all(|what| what.1 == Rejection::Session));
}

/// Another with the very key, while a session lives: refused, reported on both sides, and nothing disturbed.
#[test]
fn a_second_master_is_refused() {
    let mut pair = Pair::opened();
    let mut second = end(settings(Role::Master), key(), 55);
    let mut entropy = Numbers(56);
    let hello = second.poll(0, &mut entropy).unwrap().unwrap();
    let now_ns = pair.now_ns;
    let Ok(Received::Reply(mut answer)) = pair.slave.receive(now_ns, &mut hello.clone(), &mut entropy) else {
        panic!("an authentic hello is answered");
    };
    assert_eq!(pair.slave.poll_event(), None, "it may be a recorded message");
    assert_eq!(second.receive(10, &mut answer, &mut entropy), Ok(Received::Nothing));
    assert_eq!(
        second.poll_event(),
        Some(HandshakeEvent::Refused { decision: HandshakeDecision::Leased, form: FrameForm(92) })
    );
    assert!(!second.session.is_open(10));
    // A second later it asks again, with what the refusal gave it: it lives.
    assert_eq!(second.poll(999 * MS, &mut entropy), Ok(None));
    let hello = second.poll(1001 * MS, &mut entropy).unwrap().unwrap();
    pair.slave.receive(now_ns + 1000 * MS, &mut hello.clone(), &mut entropy).unwrap();
    assert!(matches!(pair.slave.poll_event(), Some(HandshakeEvent::SecondMaster { .. })));
    // Recorded and sent to a slave that has forgotten all: no more.
    let mut anew = Pair::opened();
    anew.slave.receive(anew.now_ns, &mut hello.clone(), &mut entropy).unwrap();
    assert_eq!(anew.slave.poll_event(), None);
    pair.run(500);
    assert_eq!(pair.rejected, []);
    assert!(pair.taken_at(Role::Slave).len() > 500);
}

/// Two masters race for a free slave: the first frame decides, and the loser is notified when it tries again.
#[test]
fn of_two_masters_at_once_one_wins() {
    let mut pair = Pair::new();
    let mut second = end(settings(Role::Master), key(), 55);
    let mut entropy = Numbers(56);
    let hello = second.poll(0, &mut entropy).unwrap().unwrap();
    let Ok(Received::Reply(mut answer)) = pair.slave.receive(0, &mut hello.clone(), &mut entropy) else {
        panic!("a free slave answers");
    };
    second.receive(1, &mut answer, &mut entropy).unwrap();
    pair.run(100);
    assert!(pair.slave.session.is_open(pair.now_ns));
    let mut buffer = [0; MAX_DATAGRAM];
    let mut late = second.session.seal(MS, &payload(1), &mut buffer).unwrap().to_vec();
    assert_eq!(pair.slave.receive(pair.now_ns, &mut late, &mut entropy), Err(Rejection::Session));
    pair.run(100);
    assert_eq!(pair.rejected, []);
}

#[test]
fn sides_of_different_payloads_are_notified() {
    let longer =
        SessionSettings { payload_length: PAYLOAD + 24, form: FrameForm(116), ..settings(Role::Slave) };
    let mut pair = Pair::with(settings(Role::Master), longer);
    pair.run(50);
    let decision = HandshakeDecision::PayloadForm;
    let refused = |form| Some(HandshakeEvent::Refused { decision, form: FrameForm(form) });
    assert_eq!(pair.master.poll_event(), refused(116));
    assert_eq!(pair.slave.poll_event(), refused(92));
    assert_eq!(pair.taken, []);
}

#[test]
fn a_short_outage_ends_nothing() {
    for (from, until) in [(100, 1500), (100, 10_000)] {
        let mut pair = Pair::new();
        pair.fate = Box::new(
            move |at, _, _| {
                if (from * MS..until * MS).contains(&at) { vec![] } else { vec![5 * MS] }
            },
        );
        pair.run(until + 3000);
        let events = epochs(&mut pair.slave);
        assert_eq!(events.len(), 1, "{events:?}");
        assert_eq!(pair.taken_at(Role::Slave).last(), Some(&((until + 2995) * MS)));
        assert_eq!(pair.slave.poll_event(), None, "the holder itself is no second master");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Whatever order frames and their copies arrive in, each is taken once, and only newer ones as newer.
    #[test]
    fn each_frame_is_taken_once(order in prop::collection::vec(0usize..200, 1..400)) {
        let mut pair = Pair::opened();
        let mut buffer = [0; MAX_DATAGRAM];
        let frames: Vec<_> = (0..200)
            .map(|n| pair.master.session.seal(pair.now_ns, &payload(n), &mut buffer).unwrap().to_vec())
            .collect();
        let mut seen = std::collections::BTreeSet::new();
        for &n in &order {
            let newest = seen.last().copied();
            let mut datagram = frames[n].clone();
            match pair.slave.receive(pair.now_ns, &mut datagram, &mut Numbers(0)) {
                Ok(Received::Payload { payload, arrival }) => {
                    prop_assert_eq!(number(payload), n as u64);
                    prop_assert_eq!(arrival == Arrival::Newer, newest.is_none_or(|newest| n > newest));
                    prop_assert!(seen.insert(n));
                }
                other => {
                    prop_assert_eq!(other, Err(Rejection::Repeated));
                    prop_assert!(seen.contains(&n));
                }
            }
        }
    }

    #[test]
    fn sides_find_each_other_over_any_bearable_network(
        seed in any::<u64>(), loss in 0u64..30, max_ms in 1u64..400,
    ) {
        let mut pair = Pair::new();
        let mut numbers = Numbers(seed);
        pair.fate = Box::new(move |_, _, _| {
            if numbers.draw() % 100 < loss { vec![] } else { vec![numbers.draw() % (max_ms * MS)] }
        });
        // A hello is repeated every 2 s at most, and of a hello and its answer half are lost at worst: that none of 17
        // comes through in 30 s has a probability of 1e-5.
        pair.run(30_000);
        let session = pair.master.session.session();
        prop_assert!(session.is_some());
        prop_assert_eq!(pair.slave.session.session(), session);
        prop_assert!(pair.taken_at(peer(Role::Slave)).len() > 100);
    }
}
