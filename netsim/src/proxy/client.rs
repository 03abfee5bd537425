//! Whom the proxy serves on its listening side: one source at a time.

use std::net::SocketAddr;

/// Silence after which another source may take the client's place.
pub(super) const CLIENT_SILENCE_NS: u64 = 1_000_000_000;

/// The first source that speaks, for as long as it keeps speaking.
///
/// With two masters behind one proxy, the slave's answers would go to whichever spoke last.
#[derive(Debug, Default)]
pub(super) struct Client {
    /// Address and the last time it was heard.
    current: Option<(SocketAddr, u64)>,
}

impl Client {
    /// Whether a datagram that `source` sent at `now_ns` is served.
    pub(super) fn admit(&mut self, source: SocketAddr, now_ns: u64) -> bool {
        let refused = self.current.is_some_and(|(client, heard_ns)| {
            client != source && now_ns.saturating_sub(heard_ns) < CLIENT_SILENCE_NS
        });
        if !refused {
            self.current = Some((source, now_ns));
        }
        !refused
    }

    /// Where answers go.
    pub(super) fn address(&self) -> Option<SocketAddr> {
        self.current.map(|(client, _)| client)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_source_waits_until_the_client_has_been_silent() {
        let first = SocketAddr::from(([127, 0, 0, 1], 1));
        let second = SocketAddr::from(([127, 0, 0, 1], 2));
        let mut client = Client::default();
        assert_eq!(client.address(), None);
        assert!(client.admit(first, 0));
        assert!(client.admit(first, 500_000_000));
        assert!(!client.admit(second, 500_000_000 + CLIENT_SILENCE_NS - 1));
        assert_eq!(client.address(), Some(first));
        assert!(client.admit(second, 500_000_000 + CLIENT_SILENCE_NS));
        assert!(!client.admit(first, 500_000_001 + CLIENT_SILENCE_NS));
        assert_eq!(client.address(), Some(second));
    }
}
