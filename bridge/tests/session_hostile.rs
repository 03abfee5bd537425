//! The secure session against whoever writes datagrams without the key, or writes old ones again.
#![allow(clippy::unwrap_used)] // a test may

mod pair;

use haptether_bridge::{
    session::{
        HANDSHAKE_LENGTH, MAX_DATAGRAM, PreSharedKey, Received, Rejection, SessionEvent, SessionSettings,
        sealed_length,
    },
    wire::Role,
};
use pair::{KEY, MS, Numbers, PAYLOAD, Pair, end, payload, settings, state};

/// Gives `datagram` to the end of `role` and says why it was not taken; whatever else the end knows stays.
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
        // The highest bit of an X25519 key says nothing by itself, but it is hashed: it is refused as well.
        assert!(refusal(&mut pair, Role::Master, &bad).is_some(), "bit {bit} of the answer");
    }
    assert_eq!(pair.rejected, []);
    pair.run(30);
    assert!(pair.slave.session.is_open(pair.now_ns), "the true answer still opens the session");
}

#[test]
fn another_key_gets_no_answer() {
    let mut pair = Pair::new();
    pair.slave = end(settings(Role::Slave), PreSharedKey::new([0x43; 32]), 2);
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

/// The whole recording of a session, to the sides that made it, in the session and after a restart.
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
    // One answer to the one hello of a first session; the hello of the next keys is bound to keys that are gone.
    assert_eq!(anew.sent.len(), 1);
}

/// A recorded first message, again and again: answered as often as a master sends it, and no more.
#[test]
fn a_replayed_hello_is_answered_within_bounds() {
    let mut pair = Pair::new();
    pair.tick(false);
    let hello = pair.sent[0].2.clone();
    let mut answers = 0;
    for step in 0..100_000_u64 {
        let mut copy = hello.clone();
        let received = pair.slave.receive(step * MS / 4, &mut copy, &mut Numbers(6));
        answers += u64::from(matches!(received, Ok(Received::Reply(_))));
    }
    assert_eq!(answers, 8);
    assert_eq!(pair.slave.rejections().of(Rejection::Replayed), 100_000 - 8);
}

/// Many recorded first messages: bounded by the budget, and the master's own is answered once they stop.
#[test]
fn many_replayed_hellos_are_answered_within_the_budget() {
    let hellos: Vec<_> = (0..2000)
        .map(|seed| {
            let mut master = end(settings(Role::Master), KEY, 1000 + seed);
            master.poll(0, &mut Numbers(5000 + seed)).unwrap().unwrap()
        })
        .collect();
    let mut slave = end(settings(Role::Slave), KEY, 2);
    let mut answers = 0;
    for (n, hello) in hellos.iter().enumerate() {
        let mut copy = *hello;
        let received = slave.receive(n as u64 * MS, &mut copy, &mut Numbers(7));
        answers += u64::from(matches!(received, Ok(Received::Reply(_))));
    }
    // Eight at once and four a second, for two seconds.
    assert!((15..=16).contains(&answers), "{answers}");
    assert_eq!(slave.rejections().of(Rejection::Busy), 2000 - answers);

    let mut pair = Pair::new();
    pair.slave = slave;
    pair.now_ns = 2000 * MS;
    pair.run(600);
    assert!(pair.slave.session.is_open(pair.now_ns));
}

/// While a session lives, hellos recorded from others do not touch it.
#[test]
fn replayed_hellos_leave_a_living_session_alone() {
    let mut pair = Pair::opened();
    let mut other = end(settings(Role::Master), KEY, 1000);
    let hello = other.poll(0, &mut Numbers(8)).unwrap().unwrap();
    for _ in 0..2000 {
        pair.deliver(Role::Slave, hello.to_vec());
        pair.tick(true);
    }
    for _ in 0..10 {
        pair.tick(false);
    }
    let frames = pair.sent.iter().filter(|(_, to, bytes)| *to == Role::Slave && bytes.len() != 88).count();
    assert_eq!(pair.taken_at(Role::Slave).len(), frames);
    let answers = pair.sent.iter().filter(|(_, to, bytes)| *to == Role::Master && bytes.len() == 88).count();
    assert_eq!(answers, 1 + 8);
}

/// One who has the shared key and hears all, but is no end of the session, cannot put its keys in place of theirs.
#[test]
fn the_shared_key_alone_does_not_rekey_a_session_of_others() {
    let mut pair = Pair::opened();
    // Its own session with another slave gives it a hello for keys, which it relabels.
    let mut own = Pair::new();
    own.entropy = Numbers(99);
    own.run(60);
    own.master.session.rekey();
    own.run(2);
    let mut hello = own.sent.iter().rfind(|(.., bytes)| bytes.len() == 88).unwrap().2.clone();
    assert_eq!(hello[4], 1);
    hello[8..16].copy_from_slice(&pair.slave.session.session().unwrap().to_le_bytes());
    assert_eq!(refusal(&mut pair, Role::Slave, &hello), Some(Rejection::Forged));
}

#[test]
fn too_many_forgeries_end_the_session() {
    let few = |role| SessionSettings { most_forged: 10, ..settings(role) };
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

/// A million datagrams, from noise to all but right: nothing panics, nothing changes, and the counts add up.
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
                // A handshake costs a hundred times as much as a frame: fewer of them.
                1 if numbers.draw().is_multiple_of(16) => HANDSHAKE_LENGTH,
                _ => good.len(),
            };
            for chunk in buffer[..length].chunks_mut(8) {
                let bytes = numbers.draw().to_le_bytes();
                chunk.copy_from_slice(&bytes[..chunk.len()]);
            }
            // As much of a true header as the shape says: version, kind, epoch, session, some of the counter, all.
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
