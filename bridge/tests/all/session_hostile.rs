//! The secure session against an attacker who sends datagrams without the key, or replays old ones.
#![allow(clippy::unwrap_used)] // a test may

use std::net::SocketAddr;

use crate::pair::{MS, Numbers, PAYLOAD, Pair, end, key, payload, settings, state};
use haptether_bridge::{
    session::{
        Entropy, HANDSHAKE_LENGTH, Handshake, HandshakeDatagram, Incoming, MAX_DATAGRAM, NoEntropy,
        PreSharedKey, Received, Rejection, Session, SessionEnd, SessionEvent, SessionSettings, sealed_length,
    },
    wire::Role,
};

/// Pass `datagram` to the end of `role` and return the reason of a refusal. A refusal changes no other state of the
/// end.
fn refusal(pair: &mut Pair, role: Role, datagram: &[u8]) -> Option<Rejection> {
    let (before, now_ns) = (state(pair.end(role)), pair.now_ns);
    let refused = pair.end(role).receive(now_ns, &mut datagram.to_vec(), &mut Numbers(5)).err();
    if refused.is_some() {
        assert_eq!(state(pair.end(role)), before);
    }
    refused
}

#[test]
fn every_flipped_bit_of_a_frame_is_refused() {
    let mut pair = Pair::opened();
    let mut buffer = [0; MAX_DATAGRAM];
    let good = pair.master.session.seal(pair.now_ns, &payload(1), &mut buffer).unwrap().to_vec();
    for bit in 0..8 * good.len() {
        let mut bad = good.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        let cause = refusal(&mut pair, Role::Slave, &bad).unwrap();
        let expected: &[Rejection] = match bit / 8 {
            0..3 => &[Rejection::Version],
            3 => &[Rejection::Kind, Rejection::Length, Rejection::Forged],
            4..8 => &[Rejection::Epoch],
            8..16 => &[Rejection::Session],
            16..24 => &[Rejection::Forged, Rejection::Repeated, Rejection::Counter],
            _ => &[Rejection::Forged],
        };
        assert!(expected.contains(&cause), "bit {bit}: {cause}");
    }
    assert_eq!(pair.slave.rejections().total(), 8 * good.len() as u64);
    assert_eq!(refusal(&mut pair, Role::Slave, &good), None);
    assert_eq!(refusal(&mut pair, Role::Slave, &good), Some(Rejection::Repeated));
}

#[test]
fn every_flipped_bit_of_a_handshake_is_refused() {
    let mut pair = Pair::new();
    pair.tick(false);
    let hello = pair.sent[0].2.clone();
    assert_eq!(hello.len(), HANDSHAKE_LENGTH);
    for bit in 0..8 * HANDSHAKE_LENGTH {
        let mut bad = hello.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        assert!(refusal(&mut pair, Role::Slave, &bad).is_some(), "bit {bit} of the hello");
    }
    for _ in 0..5 {
        pair.tick(false);
    }
    let answer = pair.sent[1].2.clone();
    for bit in 0..8 * HANDSHAKE_LENGTH {
        let mut bad = answer.clone();
        bad[bit / 8] ^= 1 << (bit % 8);
        // The highest bit of an X25519 key has no effect by itself, but it is hashed, so a change is refused too.
        assert!(refusal(&mut pair, Role::Master, &bad).is_some(), "bit {bit} of the answer");
    }
    assert_eq!(pair.rejected, []);
    pair.run(30);
    assert!(pair.slave.session.is_open(pair.now_ns), "the true answer still opens the session");
}

#[test]
fn another_key_gets_no_answer() {
    let mut pair = Pair::new();
    pair.slave =
        end(settings(Role::Slave), PreSharedKey::new(b"the key that another pair has 32").unwrap(), 2);
    pair.run(1000);
    assert_eq!(pair.taken, []);
    assert!(pair.sent.iter().all(|(_, to, _)| *to == Role::Slave), "silence");
    assert_eq!(pair.slave.rejections().of(Rejection::Forged), 3);
}

#[test]
fn every_other_length_is_refused() {
    let mut pair = Pair::opened();
    let mut buffer = [0; MAX_DATAGRAM];
    let good = pair.master.session.seal(pair.now_ns, &payload(1), &mut buffer).unwrap().to_vec();
    let length = good.len();
    assert_eq!(length, sealed_length(PAYLOAD));
    for other in (0..400).filter(|other| *other != length) {
        let mut bad = good.clone();
        bad.resize(other, 0);
        assert_eq!(refusal(&mut pair, Role::Slave, &bad), Some(Rejection::Length), "{other} bytes");
    }
}

#[test]
fn a_datagram_sent_back_to_its_sender_is_refused() {
    let mut pair = Pair::opened();
    let mut buffer = [0; MAX_DATAGRAM];
    for _ in 0..100 {
        let good = pair.master.session.seal(pair.now_ns, &payload(1), &mut buffer).unwrap().to_vec();
        let refused = refusal(&mut pair, Role::Master, &good).unwrap();
        assert!(matches!(refused, Rejection::Forged | Rejection::Repeated));
    }
    let hello = pair.sent[0].2.clone();
    assert_eq!(refusal(&mut pair, Role::Master, &hello), Some(Rejection::Kind));
}

/// A recording of a whole session is replayed to its sides, during the session and after a restart.
#[test]
fn a_recorded_session_sent_again_does_nothing() {
    let mut pair = Pair::opened();
    pair.master.session.rekey();
    pair.run(3000);
    let recording = std::mem::take(&mut pair.sent);
    pair.taken.clear();
    for (_, to, datagram) in &recording {
        // The last few had not arrived yet.
        if let Some(cause) = refusal(&mut pair, *to, datagram) {
            let expected = [
                Rejection::Repeated,
                Rejection::TooOld,
                Rejection::Replayed,
                Rejection::Unexpected,
                Rejection::Epoch,
            ];
            assert!(expected.contains(&cause), "{cause}");
        }
    }
    let session = pair.master.session.session();
    pair.run(100);
    assert_eq!(pair.master.session.session(), session);
    assert_eq!(pair.slave.session.session(), session);

    let mut anew = Pair::new();
    for (at, to, datagram) in &recording {
        anew.now_ns = *at;
        anew.deliver(*to, datagram.clone());
    }
    assert_eq!(anew.taken, []);
    assert!(!anew.slave.session.is_leased());
    assert_eq!(anew.slave.session.poll_event(), None);
    // One answer to the one hello of a first session; the hello of the next keys depends on keys that are gone.
    assert_eq!(anew.sent.len(), 1);
}

/// Return the number of answers to `count` first messages, one every `step_ns` from the addresses of `from` in turn.
fn answers(
    slave: &mut SessionEnd,
    hellos: &[HandshakeDatagram],
    from: &[SocketAddr],
    step_ns: u64,
    count: u64,
) -> u64 {
    let of = |n: u64, length: usize| usize::try_from(n).unwrap() % length;
    (0..count)
        .filter(|n| {
            let (mut copy, from) = (hellos[of(*n, hellos.len())], from[of(*n, from.len())]);
            let received = slave.receive_from(n * step_ns, from, &mut copy, &mut Numbers(7));
            matches!(received, Ok(Received::Reply(_)))
        })
        .count() as u64
}

/// Return first messages of the peer, each of a different session.
fn recorded(count: u64) -> Vec<HandshakeDatagram> {
    (0..count)
        .map(|seed| {
            let mut master = end(settings(Role::Master), key(), 1000 + seed);
            master.poll(0, &mut Numbers(5000 + seed)).unwrap().unwrap()
        })
        .collect()
}

fn address(host: u8, port: u16) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, host], port))
}

/// Eight answers at once and four per second, repeats included. One host gets half of that, and one address a quarter.
#[test]
fn answers_have_one_limit_repeats_included() {
    let hosts: Vec<_> = (1..20).map(|host| address(host, 9)).collect();
    let ports: Vec<_> = (1..20).map(|port| address(1, port)).collect();
    // One message, some that are repeated as often as by a master, and more than are stored against replay.
    for distinct in [1, 7, 2000] {
        let hellos = recorded(distinct);
        for (from, least, most) in
            [(&hosts, 38, 8 + 40), (&ports, 18, 6 + 20), (&vec![address(1, 1)], 8, 4 + 10)]
        {
            let mut slave = end(settings(Role::Slave), key(), 2);
            // 4000 per second for 10 s.
            let given = answers(&mut slave, &hellos, from, MS / 4, 40_000);
            assert!(given <= most, "{distinct}, {} addresses: {given}", from.len());
            assert!(given >= least, "{distinct}, {} addresses: {given}", from.len());
            assert_eq!(slave.rejections().total(), 40_000 - given);
        }
    }
}

/// Recorded first messages from one address or one host do not keep out a master from another.
#[test]
fn replayed_hellos_from_elsewhere_do_not_delay_a_master() {
    let hellos = recorded(2000);
    for from in [vec![address(1, 1)], (1..1000).map(|port| address(1, port)).collect()] {
        let mut pair = Pair::new();
        for (n, hello) in hellos.iter().cycle().take(8000).enumerate() {
            let at_ns = n as u64 * MS / 4;
            let _ = pair.slave.receive_from(at_ns, from[n % from.len()], &mut { *hello }, &mut Numbers(7));
        }
        pair.now_ns = 2000 * MS;
        pair.run(30);
        assert!(pair.slave.session.is_open(pair.now_ns), "after one round trip");
    }
}

/// A copy of the master's own first message, which always arrives first and from another address: both are answered.
#[test]
fn a_copy_of_a_first_message_does_not_take_its_answer() {
    let mut slave = end(settings(Role::Slave), key(), 2);
    let hello = recorded(1)[0];
    for (n, at_ms) in [0, 250, 750, 1750].into_iter().enumerate() {
        for (from, later_ms) in [(address(2, 2), 0), (address(1, 1), 4)] {
            let (mut copy, mut entropy) = (hello, Numbers(7 + n as u64));
            let received = slave.receive_from((at_ms + later_ms) * MS, from, &mut copy, &mut entropy);
            assert!(matches!(received, Ok(Received::Reply(_))), "{from} at {at_ms} ms: {received:?}");
        }
    }
}

/// Settings with fast rekeying.
fn hasty(role: Role) -> SessionSettings {
    SessionSettings { rekey_ns: 400 * MS, refuse_ns: 1000 * MS, overlap_ns: 200 * MS, ..settings(role) }
}

/// 4000 authentic first messages per second, of other sessions or of this one, from the master's address and others.
/// Keys are renewed as usual, and no other master is reported.
#[test]
fn replayed_hellos_do_not_starve_the_next_keys() {
    for own in [false, true] {
        let mut pair = Pair::with(hasty(Role::Master), hasty(Role::Slave));
        pair.run(40);
        let mut hellos = recorded(1000);
        let mut n = 0;
        for _ in 0..10_000 {
            pair.tick(true);
            if own {
                // All first messages of this master so far, including the newest.
                let asked = pair.sent.iter().filter(|(_, to, _)| *to == Role::Slave);
                hellos = asked.filter_map(|(.., bytes)| bytes.as_slice().try_into().ok()).collect();
            }
            for _ in 0..4 {
                n += 1;
                let from = if n % 2 == 0 { address(1, 1) } else { SocketAddr::from(([0; 4], 0)) };
                let (now_ns, mut copy) = (pair.now_ns, hellos[n % hellos.len()]);
                let received = pair.slave.receive_from(now_ns, from, &mut copy, &mut Numbers(7));
                // Answers for the partner go to the partner, as the next test checks; others go to the sender.
                if let Ok(Received::Reply(reply)) = received
                    && reply[4..8] != [0; 4]
                {
                    pair.carry(Role::Master, &reply);
                }
            }
            assert!(pair.slave.session.is_open(pair.now_ns) && pair.master.session.is_open(pair.now_ns));
            assert_eq!(pair.slave.poll_event(), None);
        }
        let events: Vec<_> = std::iter::from_fn(|| pair.slave.session.poll_event()).collect();
        let renewals = events.iter().filter(|event| matches!(event, SessionEvent::Rekeyed { .. })).count();
        assert!((20..=25).contains(&renewals), "{events:?}");
        assert!(!events.iter().any(|event| matches!(event, SessionEvent::Aging { .. })), "{events:?}");
    }
}

/// Answers to the partner of a live session go to the source of its frames, whatever address asks.
#[test]
fn an_answer_to_the_living_partner_goes_to_it() {
    let mut entropy = Numbers(4);
    let mut pair = Pair::new();
    let mut handshake = Handshake::new(settings(Role::Slave), key(), &mut entropy).unwrap();
    let mut session = Session::secure(settings(Role::Slave), &key()).unwrap();
    let mut buffer = [0; MAX_DATAGRAM];
    let mut ask = |session: &mut Session, now_ns, mut hello: HandshakeDatagram| {
        let Ok(Incoming::Handshake { datagram, is_renewal }) = session.open(now_ns, &mut hello) else {
            panic!()
        };
        let outcome = handshake
            .receive(now_ns, address(9, 9), datagram, &session.status(now_ns), &mut entropy)
            .unwrap();
        (outcome, is_renewal)
    };
    let mut entropy = Numbers(5);
    let hello = pair.master.poll(0, &mut entropy).unwrap().unwrap();
    let (outcome, is_renewal) = ask(&mut session, 0, hello);
    assert!(!is_renewal && !outcome.to_peer, "nobody is known yet");
    session.install(0, outcome.keys.unwrap());
    pair.master.receive(0, &mut outcome.reply.unwrap(), &mut entropy).unwrap();
    let mut frame = pair.master.session.seal(0, &payload(1), &mut buffer).unwrap().to_vec();
    session.open(0, &mut frame).unwrap();
    let mut frame = session.seal(0, &payload(1), &mut buffer).unwrap().to_vec();
    pair.master.receive(0, &mut frame, &mut entropy).unwrap();
    pair.master.session.rekey();
    let hello = pair.master.poll(MS, &mut entropy).unwrap().unwrap();
    for now_ns in [MS, 2 * MS] {
        let (outcome, is_renewal) = ask(&mut session, now_ns, hello);
        assert!(is_renewal && outcome.to_peer && outcome.reply.is_some());
    }
    // After a long silence its address may be another.
    let (outcome, _) = ask(&mut session, 3000 * MS, hello);
    assert!(!outcome.to_peer && outcome.reply.is_some());
}

/// During a session, hellos recorded from others do not affect it.
#[test]
fn replayed_hellos_leave_a_living_session_alone() {
    let mut pair = Pair::opened();
    let hello = recorded(1)[0];
    for _ in 0..2000 {
        pair.deliver(Role::Slave, hello.to_vec());
        pair.tick(true);
    }
    for _ in 0..10 {
        pair.tick(false);
    }
    let is_handshake = |bytes: &[u8]| bytes.len() == HANDSHAKE_LENGTH;
    let frames = pair.sent.iter().filter(|(_, to, bytes)| *to == Role::Slave && !is_handshake(bytes)).count();
    assert_eq!(pair.taken_at(Role::Slave).len(), frames);
    let answers =
        pair.sent.iter().filter(|(_, to, bytes)| *to == Role::Master && is_handshake(bytes)).count();
    // Four at once, one of them for the master itself, and two more in 2 s.
    assert!((5..=6).contains(&answers), "{answers}");
    assert_eq!(pair.slave.poll_event(), None, "a recorded message is no second master");
}

/// An attacker who has the shared key and hears everything, but is no end of the session, cannot replace its keys.
#[test]
fn the_shared_key_alone_does_not_rekey_a_session_of_others() {
    /// Entropy that returns a known session number first, then its own numbers.
    struct Chosen(Option<u64>, Numbers);
    impl Entropy for Chosen {
        fn fill(&mut self, bytes: &mut [u8]) -> Result<(), NoEntropy> {
            match self.0.take_if(|_| bytes.len() == 8) {
                Some(number) => bytes.copy_from_slice(&number.to_le_bytes()),
                None => return self.1.fill(bytes),
            }
            Ok(())
        }
    }
    let mut pair = Pair::opened();
    let mut entropy = Chosen(pair.slave.session.session(), Numbers(99));
    // With another slave, a session of the same number gives the attacker a hello for the next keys.
    let mut master = end(settings(Role::Master), key(), 7);
    let mut slave = end(settings(Role::Slave), key(), 8);
    let mut hello = master.poll(0, &mut entropy).unwrap().unwrap();
    let Ok(Received::Reply(mut answer)) = slave.receive(0, &mut hello, &mut Numbers(98)) else { panic!() };
    master.receive(0, &mut answer, &mut entropy).unwrap();
    let mut buffer = [0; MAX_DATAGRAM];
    let mut frame = master.session.seal(0, &payload(1), &mut buffer).unwrap().to_vec();
    slave.receive(0, &mut frame, &mut entropy).unwrap();
    let mut frame = slave.session.seal(0, &payload(1), &mut buffer).unwrap().to_vec();
    master.receive(0, &mut frame, &mut entropy).unwrap();
    master.session.rekey();
    let hello = master.poll(0, &mut entropy).unwrap().unwrap();
    assert_eq!(hello[4], 1);
    assert_eq!(hello[8..16], pair.slave.session.session().unwrap().to_le_bytes());
    assert_eq!(refusal(&mut pair, Role::Slave, &hello), Some(Rejection::Forged));
    let now_ns = pair.now_ns;
    assert!(
        matches!(slave.receive(0, &mut { hello }, &mut entropy), Ok(Received::Reply(_))),
        "but it is well made"
    );
    pair.master.session.rekey();
    pair.run(100);
    assert!(pair.slave.session.is_open(now_ns));
}

#[test]
fn too_many_forgeries_end_the_session() {
    let few = |role| SessionSettings { max_forged: 10, ..settings(role) };
    let mut pair = Pair::with(few(Role::Master), few(Role::Slave));
    pair.run(50);
    let mut buffer = [0; MAX_DATAGRAM];
    let mut bad = pair.master.session.seal(pair.now_ns, &payload(1), &mut buffer).unwrap().to_vec();
    bad[50] ^= 1;
    for _ in 0..9 {
        assert_eq!(refusal(&mut pair, Role::Slave, &bad), Some(Rejection::Forged));
    }
    assert!(pair.slave.session.is_open(pair.now_ns));
    assert_eq!(pair.slave.receive(pair.now_ns, &mut bad, &mut Numbers(0)), Err(Rejection::Forged));
    assert!(!pair.slave.session.is_open(pair.now_ns));
    let mut last = None;
    while let Some(event) = pair.slave.session.poll_event() {
        last = Some(event);
    }
    assert_eq!(last, Some(SessionEvent::Forgeries));
}

/// A million datagrams, from noise to almost valid: nothing panics, nothing changes, and the counts add up.
#[test]
fn a_million_forgeries_change_nothing() {
    const COUNT: u64 = 1_000_000;
    let mut pair = Pair::opened();
    let mut numbers = Numbers(11);
    let mut sink = [0; MAX_DATAGRAM];
    let good = pair.master.session.seal(pair.now_ns, &payload(1), &mut sink).unwrap().to_vec();
    let hello = pair.sent[0].2.clone();
    for role in [Role::Slave, Role::Master] {
        let now_ns = pair.now_ns;
        let (before, counted) = (state(pair.end(role)), pair.end(role).rejections().total());
        let mut buffer = [0_u8; 600];
        for _ in 0..COUNT / 2 {
            let shape = numbers.draw() % 8;
            let length = match shape {
                0 => (numbers.draw() % 600) as usize,
                // A handshake costs a hundred times as much as a frame, so there are fewer of them.
                1 if numbers.draw().is_multiple_of(16) => HANDSHAKE_LENGTH,
                _ => good.len(),
            };
            for chunk in buffer[..length].chunks_mut(8) {
                let bytes = numbers.draw().to_le_bytes();
                chunk.copy_from_slice(&bytes[..chunk.len()]);
            }
            // The shape decides how much of a true header is kept: version, kind, epoch, session, part of the counter,
            // or all.
            let truth = if length == HANDSHAKE_LENGTH { &hello } else { &good };
            let keep = [0, 3, 4, 8, 16, 18, 22, 24][shape as usize].min(length);
            buffer[..keep].copy_from_slice(&truth[..keep]);
            if keep == 8 {
                // The session without its epoch.
                buffer[8..16].copy_from_slice(&truth[8..16]);
                buffer[7] |= 1;
            }
            let refused = pair.end(role).receive(now_ns, &mut buffer[..length], &mut numbers);
            assert!(refused.is_err());
        }
        assert_eq!(state(pair.end(role)), before);
        let rejections = pair.end(role).rejections();
        assert_eq!(rejections.total() - counted, COUNT / 2);
        for cause in [
            Rejection::Length,
            Rejection::Version,
            Rejection::Kind,
            Rejection::Epoch,
            Rejection::Session,
            Rejection::Counter,
            Rejection::Forged,
        ] {
            assert!(rejections.of(cause) > 100, "{cause}: {}", rejections.of(cause));
        }
    }
    assert_eq!(refusal(&mut pair, Role::Slave, &good), None);
}

/// Garbage that looks like a first message never passes its MAC, so nothing reaches the handshake.
#[test]
#[allow(clippy::cast_possible_truncation)] // a draw of bits
fn garbage_without_the_key_is_not_handed_on() {
    let mut session = Session::secure(settings(Role::Slave), &key()).unwrap();
    let hello = recorded(1)[0];
    let mut numbers = Numbers(12);
    for n in 0..10_000_u64 {
        let mut garbage = hello;
        // Another session and random bytes, or one flipped bit of the true message.
        if n % 2 == 0 {
            numbers.fill(&mut garbage[8..16]).unwrap();
            numbers.fill(&mut garbage[24..]).unwrap();
        } else {
            let bit = 64 + numbers.draw() as usize % (8 * (HANDSHAKE_LENGTH - 8));
            if (128..192).contains(&bit) {
                continue;
            }
            garbage[bit / 8] ^= 1 << (bit % 8);
        }
        assert_eq!(session.open(0, &mut garbage).unwrap_err(), Rejection::Forged);
    }
    assert!(matches!(session.open(0, &mut { hello }), Ok(Incoming::Handshake { is_renewal: false, .. })));
}

/// A repeated datagram is a sign of life, so it must be authentic.
#[test]
fn a_repeat_that_is_changed_is_forged() {
    let mut pair = Pair::opened();
    let mut buffer = [0; MAX_DATAGRAM];
    let good = pair.master.session.seal(pair.now_ns, &payload(1), &mut buffer).unwrap().to_vec();
    assert_eq!(refusal(&mut pair, Role::Slave, &good), None);
    let mut changed = good.clone();
    changed[60] ^= 1;
    assert_eq!(refusal(&mut pair, Role::Slave, &changed), Some(Rejection::Forged));
    assert_eq!(refusal(&mut pair, Role::Slave, &good), Some(Rejection::Repeated));
}
