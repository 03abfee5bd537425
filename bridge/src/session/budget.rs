//! Rate limits of requests that anybody may send: in total, per host and per address.

use std::net::{IpAddr, SocketAddr};

/// Budget that refills at a steady rate.
///
/// Source: ITU-T I.371, the generic cell rate algorithm, virtual scheduling.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Bucket {
    /// Time in ns at which the budget is full again.
    full_ns: u64,
}

impl Bucket {
    /// Return the budget after one request at `now_ns`, if `burst` and one request per `interval_ns` allow
    /// it.
    fn after(self, now_ns: u64, interval_ns: u64, burst: u64) -> Option<Self> {
        let full_ns = self.full_ns.max(now_ns).saturating_add(interval_ns);
        (full_ns - now_ns <= burst.saturating_mul(interval_ns)).then_some(Self { full_ns })
    }

    /// Take one request from the budget; return whether it was available.
    pub(crate) fn take(&mut self, now_ns: u64, interval_ns: u64, burst: u64) -> bool {
        let after = self.after(now_ns, interval_ns, burst);
        *self = after.unwrap_or(*self);
        after.is_some()
    }
}

/// Largest burst in total, per host, and per address.
const BURSTS: [u64; 3] = [8, 6, 4];
/// Number of hosts, and of addresses, in the table. A new one replaces the one whose budget has been full the
/// longest.
const PLACES: usize = 32;

/// Budget shared by all senders: one host gets at most half, one address a quarter, so none takes it from the
/// others.
#[derive(Clone, Debug)]
pub(crate) struct Shares {
    interval_ns: u64,
    all: Bucket,
    hosts: [(Option<IpAddr>, Bucket); PLACES],
    addresses: [(Option<SocketAddr>, Bucket); PLACES],
}

impl Shares {
    /// Build a budget of one request per `interval_ns` in total.
    pub(crate) fn new(interval_ns: u64) -> Self {
        let none = Bucket::default();
        Self { interval_ns, all: none, hosts: [(None, none); PLACES], addresses: [(None, none); PLACES] }
    }

    /// Take one request for `from`; if any share does not allow it, take nothing and return false.
    pub(crate) fn take(&mut self, now_ns: u64, from: SocketAddr) -> bool {
        let host = host(from.ip());
        let [all, of_host, of_address] = BURSTS;
        let at_host = place(&self.hosts, host);
        let at_address = place(&self.addresses, from);
        let known_host = self.hosts[at_host].1.only_of(self.hosts[at_host].0 == Some(host));
        let known_address = self.addresses[at_address].1.only_of(self.addresses[at_address].0 == Some(from));
        let (Some(all), Some(in_host), Some(in_address)) = (
            self.all.after(now_ns, self.interval_ns, all),
            known_host.after(now_ns, 2 * self.interval_ns, of_host),
            known_address.after(now_ns, 4 * self.interval_ns, of_address),
        ) else {
            return false;
        };
        self.all = all;
        self.hosts[at_host] = (Some(host), in_host);
        self.addresses[at_address] = (Some(from), in_address);
        true
    }
}

impl Bucket {
    /// Return this budget if `is_same`, else a full one for a new sender.
    fn only_of(self, is_same: bool) -> Self {
        if is_same { self } else { Self::default() }
    }
}

/// Index of `who` in the table, or of the entry whose budget has been full the longest.
fn place<K: Copy + PartialEq>(table: &[(Option<K>, Bucket)], who: K) -> usize {
    let known = table.iter().position(|(key, _)| *key == Some(who));
    let longest = || table.iter().enumerate().min_by_key(|(_, (_, bucket))| bucket.full_ns).map(|(at, _)| at);
    known.or_else(longest).unwrap_or(0)
}

/// Host of an address. For IPv6 it is the 64-bit network, because one host may choose any address in it.
fn host(address: IpAddr) -> IpAddr {
    match address {
        IpAddr::V4(_) => address,
        IpAddr::V6(address) => {
            let [a, b, c, d, ..] = address.segments();
            IpAddr::from([a, b, c, d, 0, 0, 0, 0])
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;
    const SECOND: u64 = 1000 * MS;

    fn address(text: &str) -> SocketAddr {
        text.parse().unwrap()
    }

    /// Number of admitted requests from `from`, round robin, one per ms for `seconds`.
    fn taken(shares: &mut Shares, from: &[SocketAddr], seconds: u64) -> usize {
        let turns = from.iter().cycle();
        (0..seconds * 1000).zip(turns).filter(|(n, from)| shares.take(n * MS, **from)).count()
    }

    #[test]
    fn an_address_has_a_quarter_a_host_half() {
        let (one, other) = (address("10.0.0.1:1"), address("10.0.0.1:2"));
        let far = address("10.0.0.2:1");
        // The burst, then one, two or four per second for 10 s, without the first moment.
        assert_eq!(taken(&mut Shares::new(250 * MS), &[one], 10), 4 + 9);
        let ports: Vec<_> = (1..30).map(|port| SocketAddr::new(one.ip(), port)).collect();
        assert!((24..=26).contains(&taken(&mut Shares::new(250 * MS), &ports, 10)));
        let hosts: Vec<_> = (1..30).map(|n| SocketAddr::from(([10, 0, 0, n], 1))).collect();
        assert!((46..=48).contains(&taken(&mut Shares::new(250 * MS), &hosts, 10)));
        // A flood from one address excludes nobody: neither its host nor other hosts.
        let mut shares = Shares::new(250 * MS);
        for n in 0..10_000 {
            shares.take(n * MS, one);
        }
        // Just before the next request of this address.
        let now_ns = 10 * SECOND - 1;
        assert!(!shares.take(now_ns, one));
        assert!(shares.take(now_ns, other) && shares.take(now_ns, far));
        // A flood from all ports of one host leaves the other hosts their half.
        let mut shares = Shares::new(250 * MS);
        for port in 0..20_000_u16 {
            shares.take(u64::from(port) * MS / 2, SocketAddr::new(one.ip(), port));
        }
        for n in 0..4 {
            assert!(shares.take(10 * SECOND, far), "{n}");
        }
    }

    #[test]
    fn a_network_of_ipv6_is_one_host() {
        let mut shares = Shares::new(250 * MS);
        let addresses: Vec<_> = (1..30).map(|n| address(&format!("[2001:db8:0:1::{n}]:9"))).collect();
        assert!((24..=26).contains(&taken(&mut shares, &addresses, 10)));
        assert!(shares.take(10 * SECOND, address("[2001:db8:0:2::1]:9")));
    }

    #[test]
    fn the_end_of_time_does_not_overflow() {
        let mut shares = Shares::new(250 * MS);
        assert!(shares.take(u64::MAX - 1, address("10.0.0.1:1")));
    }
}
