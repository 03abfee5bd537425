//! What stands between a side and the network where nothing runs beside the tick: a session with both its halves.

use crate::{
    session::{
        EndError, HandshakeDatagram, MAX_DATAGRAM, PreSharedKey, Received, Rejections, SeededEntropy,
        Session, SessionEnd, SessionSettings,
    },
    side::Side,
    wire::{MAX_FRAME, Role},
};

/// A session of a simulated side: whatever it draws, its seed decides.
#[derive(Debug)]
pub(crate) struct Channel {
    end: SessionEnd,
    entropy: SeededEntropy,
}

impl Channel {
    /// The session of a side `S`; secure with the seed of its keys, insecure without.
    pub(crate) fn new<S: Side>(role: Role, peer_period_ns: u64, seed: Option<u64>) -> Result<Self, EndError> {
        let settings = SessionSettings::new(role, S::FRAME_LENGTH, peer_period_ns);
        let mut entropy = SeededEntropy::new(seed.unwrap_or_default(), role);
        let end = if seed.is_some() {
            // Nobody listens in a simulation: any key will do.
            let key = PreSharedKey::new(b"the key of simulated sides alone")?;
            SessionEnd::secure(settings, key, &mut entropy)?
        } else {
            SessionEnd::insecure(settings)?
        };
        Ok(Self { end, entropy })
    }

    /// Hands what a datagram holds to the side; gives the answer to send, if it was a handshake.
    pub(crate) fn receive(
        &mut self,
        now_ns: u64,
        datagram: &mut [u8],
        side: &mut impl Side,
    ) -> Option<HandshakeDatagram> {
        match self.end.receive(now_ns, datagram, &mut self.entropy) {
            Ok(Received::Payload { payload, .. }) => {
                // A refusal is counted by the endpoint.
                let _ = side.receive(now_ns, payload);
                None
            }
            Ok(Received::Reply(answer)) => Some(answer),
            // A rejection is counted by the session.
            Ok(Received::Nothing) | Err(_) => None,
        }
    }

    /// Lets time pass; gives a handshake to send, if one is due.
    pub(crate) fn poll(&mut self, now_ns: u64) -> Option<HandshakeDatagram> {
        // Seeded randomness does not fail.
        self.end.poll(now_ns, &mut self.entropy).ok().flatten()
    }

    /// The side's next frame as it goes over the network; none while there are no keys.
    pub(crate) fn send<'a>(
        &mut self,
        now_ns: u64,
        side: &mut impl Side,
        buffer: &'a mut [u8; MAX_DATAGRAM],
    ) -> Option<&'a [u8]> {
        sealed_frame(&mut self.end.session, now_ns, side, buffer)
    }

    /// Datagrams not taken, by cause.
    pub(crate) fn rejections(&self) -> Rejections {
        self.end.rejections()
    }
}

/// The next frame of a side as a datagram of its session; none, and no frame is numbered, while there are no keys.
pub(crate) fn sealed_frame<'a>(
    session: &mut Session,
    now_ns: u64,
    side: &mut impl Side,
    buffer: &'a mut [u8; MAX_DATAGRAM],
) -> Option<&'a [u8]> {
    if !session.is_open(now_ns) {
        return None;
    }
    let mut frame = [0; MAX_FRAME];
    session.seal(now_ns, side.send(now_ns, &mut frame), buffer).ok()
}
