//! Addresses as text: `HOST:PORT`, where a name may have several addresses and an IPv6 address a zone.

use std::net::{IpAddr, Ipv6Addr, SocketAddr, SocketAddrV6, ToSocketAddrs};

use nix::net::if_::if_nametoindex;

/// Index of a zone, given as a number or as a network interface name.
///
/// Source: RFC 4007, section 11.
fn zone_index(zone: &str) -> Result<u32, String> {
    if let Ok(number) = zone.parse() {
        return Ok(number);
    }
    if_nametoindex(zone).map_err(|_| format!("this machine has no network interface {zone:?}"))
}

/// IP address and the zone after its `%`; zone 0 if absent.
pub(crate) fn ip_and_zone(text: &str) -> Result<(IpAddr, u32), String> {
    let refuse = || "invalid IP address".to_owned();
    match text.split_once('%') {
        None => text.parse().map(|ip| (ip, 0)).map_err(|_| refuse()),
        Some((ip, zone)) => {
            let ip: Ipv6Addr = ip.parse().map_err(|_| refuse())?;
            Ok((ip.into(), zone_index(zone)?))
        }
    }
}

/// Socket address with a zone, such as `[fe80::1%eth0]:9000`; `None` if the text has no zone.
fn with_zone(text: &str) -> Option<Result<SocketAddr, String>> {
    let (host, port) = text.strip_prefix('[')?.rsplit_once("]:")?;
    if !host.contains('%') {
        return None;
    }
    let port = port.parse().map_err(|_| "invalid port value".to_owned());
    Some(ip_and_zone(host).and_then(|(ip, zone)| {
        let port = port?;
        Ok(match ip {
            // The kernel reports a zone only for link-local addresses: another address with a zone would
            // compare unequal.
            IpAddr::V6(ip) if ip.is_unicast_link_local() => SocketAddrV6::new(ip, port, 0, zone).into(),
            ip => (ip, port).into(),
        })
    }))
}

/// All addresses of `text`, in the order of the system's resolver.
///
/// # Errors
///
/// Unknown host, or a form other than `HOST:PORT`.
pub fn addresses(text: &str) -> Result<Vec<SocketAddr>, String> {
    let found = match with_zone(text) {
        Some(address) => vec![address?],
        None => text.to_socket_addrs().map_err(|error| error.to_string())?.collect(),
    };
    let mut distinct = Vec::with_capacity(found.len());
    for address in found {
        if !distinct.contains(&address) {
            distinct.push(address);
        }
    }
    if distinct.is_empty() { Err("no such address".into()) } else { Ok(distinct) }
}

/// Reason why an address cannot be a peer's; `None` if it can.
pub fn unsuited_peer(address: SocketAddr) -> Option<&'static str> {
    let ip = address.ip().to_canonical();
    let is_broadcast = matches!(ip, IpAddr::V4(ip) if ip.is_broadcast());
    let is_link_local = matches!(address, SocketAddr::V6(to) if to.ip().is_unicast_link_local());
    let has_zone = matches!(address, SocketAddr::V6(to) if to.scope_id() != 0);
    if ip.is_unspecified() {
        Some("is every address of the machine that listens, and none to send to")
    } else if ip.is_multicast() || is_broadcast {
        Some("is many machines, and none that answers")
    } else if address.port() == 0 {
        Some("must name a port from 1 to 65535")
    } else if is_link_local && !has_zone {
        Some("is on every network of this machine; name one behind a %, as in [fe80::1%eth0]:9000")
    } else {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zones_are_names_or_numbers() {
        let loopback = if_nametoindex("lo").unwrap();
        let of = |text: &str| addresses(text).map(|found| found[0]);
        for (text, zone) in [("[fe80::1%lo]:9", loopback), ("[fe80::1%7]:9", 7), ("[fe80::1]:9", 0)] {
            let expected = SocketAddrV6::new("fe80::1".parse().unwrap(), 9, 0, zone);
            assert_eq!(of(text), Ok(expected.into()), "{text}");
        }
        // The kernel reports a zone for none of these.
        assert_eq!(of("[::1%lo]:9"), Ok("[::1]:9".parse().unwrap()));
        for text in
            ["[fe80::1%nowhere]:9", "[fe80::1%lo]:x", "[127.0.0.1%lo]:9", "[fe80::1%]:9", "fe80::1%lo"]
        {
            assert!(of(text).is_err(), "{text}");
        }
        assert!(of("[fe80::1%nowhere]:9").unwrap_err().contains("\"nowhere\""));
    }

    #[test]
    fn a_peer_is_one_machine() {
        for (text, is_suited) in [
            ("0.0.0.0:9", false),
            ("[::]:9", false),
            ("[::ffff:0.0.0.0]:9", false),
            ("255.255.255.255:9", false),
            ("224.0.0.1:9", false),
            ("[ff02::1]:9", false),
            ("127.0.0.1:0", false),
            ("[fe80::1]:9", false),
            ("[fe80::1%3]:9", true),
            ("[::1]:9", true),
            ("192.0.2.7:9", true),
        ] {
            assert_eq!(unsuited_peer(addresses(text).unwrap()[0]).is_none(), is_suited, "{text}");
        }
    }
}
