//! Fuzz target: what a session does with datagrams of somebody who has heard all of it, but has no key.
//!
//! The first byte says who receives them and what they are made of, the rest is the datagram, or what a true one is
//! changed by (exclusive or, and length).

use std::cell::RefCell;

use haptether_bridge::{
    session::{HANDSHAKE_LENGTH, Incoming, MAX_DATAGRAM, Rejection, Session, SessionEnd, sealed_length},
    wire::Role,
};

use crate::pair::{MS, Numbers, PAYLOAD, Pair, payload, settings, state};

/// Both ends at some time, with datagrams that the network carried.
struct Scenario {
    pair: Pair,
    /// For master and slave: sealed and not arrived yet, sealed and arrived, of the handshake.
    heard: [[Vec<u8>; 3]; 2],
}

thread_local! {
    /// A session that lives; and one of which the first message and its answer have been sent, and not arrived.
    static SCENARIOS: RefCell<[Scenario; 2]> = RefCell::new([living(), beginning()]);
}

const ROLES: [Role; 2] = [Role::Master, Role::Slave];

fn living() -> Scenario {
    let mut pair = Pair::opened();
    let now_ns = pair.now_ns;
    let heard = ROLES.map(|to| {
        let from = crate::pair::peer(to);
        let handshake =
            pair.sent.iter().find(|(_, at, bytes)| *at == to && bytes.len() == HANDSHAKE_LENGTH).unwrap();
        let old =
            pair.sent.iter().rfind(|(_, at, bytes)| *at == to && bytes.len() != HANDSHAKE_LENGTH).unwrap();
        let (handshake, old) = (handshake.2.clone(), old.2.clone());
        let mut buffer = [0; MAX_DATAGRAM];
        let new = pair.end(from).session.seal(now_ns, &payload(1), &mut buffer).unwrap().to_vec();
        [new, old, handshake]
    });
    Scenario { pair, heard }
}

fn beginning() -> Scenario {
    let old = living().heard;
    let mut pair = Pair::new();
    pair.fate = Box::new(|_, _, _| Vec::new());
    pair.tick(false);
    let hello = pair.sent[0].2.clone();
    // A slave of the same key, which is not this one, answers.
    let mut other = Pair::new();
    other.deliver(Role::Slave, hello.clone());
    let answer = other.sent[0].2.clone();
    let [[to_master, old_to_master, _], [to_slave, old_to_slave, _]] = old;
    Scenario { pair, heard: [[to_master, old_to_master, answer], [to_slave, old_to_slave, hello]] }
}

/// Panics if a datagram that no peer made is taken, answered, or changes anything but counts.
pub(crate) fn check(bytes: &[u8]) {
    let Some((&choice, rest)) = bytes.split_first() else { return };
    let to = usize::from(choice & 1);
    let base = usize::from(choice >> 1 & 3);
    SCENARIOS.with_borrow_mut(|scenarios| {
        let Scenario { pair, heard } = &mut scenarios[usize::from(choice >> 3 & 1)];
        let mut datagram = rest.to_vec();
        if let Some(truth) = base.checked_sub(1).map(|base| &heard[to][base]) {
            if rest.iter().all(|byte| *byte == 0) && rest.len() == truth.len() {
                // Nothing was changed: that is the peer's own.
                return;
            }
            datagram.iter_mut().zip(truth).for_each(|(byte, truth)| *byte ^= truth);
        }
        refused(pair.end(ROLES[to]), pair_time(choice), &datagram);
        unprotected(ROLES[to], &datagram);
    });
}

/// The time of both scenarios is past; the choice says by how much, up to where keys have grown too old.
fn pair_time(choice: u8) -> u64 {
    [100 * MS, 1000 * MS, 100_000 * MS, 200_000 * MS][usize::from(choice >> 4 & 3)]
}

fn refused(end: &mut SessionEnd, now_ns: u64, datagram: &[u8]) {
    let (before, counted) = (state(end), end.rejections().total());
    let mut bytes = datagram.to_vec();
    let answer = end.receive(now_ns, &mut bytes, &mut Numbers(5));
    let Err(cause) = answer else { panic!("a forgery was taken: {answer:?}") };
    assert_eq!(state(end), before, "{cause}");
    assert_eq!(end.rejections().total(), counted + 1, "{cause}");
    let fits = [sealed_length(PAYLOAD), HANDSHAKE_LENGTH].contains(&datagram.len());
    assert!(fits || cause == Rejection::Length, "{cause}");
    assert!(!cause.to_string().is_empty());
}

/// Without security a payload is what has its length, and nothing else is read into it.
fn unprotected(role: Role, datagram: &[u8]) {
    let mut session = Session::insecure(settings(role)).unwrap();
    let mut bytes = datagram.to_vec();
    match session.open(MS, &mut bytes) {
        Ok(Incoming::Payload { payload, .. }) => assert!(payload == datagram && payload.len() == PAYLOAD),
        Err(Rejection::Length) => assert_ne!(datagram.len(), PAYLOAD),
        other => panic!("{other:?}"),
    }
}
