//! Fuzz target: the decoder of frames.

use haptether_bridge::{
    HeardText,
    wire::{Frame, MAX_FRAME, Role, WireError, frame_length},
};

/// Bytes of the checksum at the end.
const CHECKSUM: usize = 4;

/// Panics unless `bytes` are refused with a word why, or are the very bytes of the frame that they decode to.
///
/// As they are, and under a checksum that is right: a fuzzer does not guess one.
pub(crate) fn check(bytes: &[u8]) {
    for role in [Role::Master, Role::Slave] {
        as_axes::<1>(bytes, role);
        as_axes::<2>(bytes, role);
        as_axes::<3>(bytes, role);
        as_axes::<6>(bytes, role);
        as_axes::<7>(bytes, role);
    }
}

fn as_axes<const N: usize>(bytes: &[u8], role: Role) {
    assert_eq!(Frame::<N>::LENGTH, frame_length(N, false));
    assert_eq!(Frame::<N>::LENGTH_WITH_GRIPPER, frame_length(N, true));
    if ![Frame::<N>::LENGTH, Frame::<N>::LENGTH_WITH_GRIPPER].contains(&bytes.len()) {
        let refused = Frame::<N>::decode(bytes, role);
        assert_eq!(refused, Err(WireError::Length { seen: bytes.len(), allowed: Frame::<N>::LENGTH }));
        return;
    }
    let _ = decode::<N>(bytes, role);
    let mut sealed = bytes.to_vec();
    let end = sealed.len() - CHECKSUM;
    let checksum = crc32fast::hash(&sealed[..end]);
    sealed[end..].copy_from_slice(&checksum.to_le_bytes());
    if let Err(error) = decode::<N>(&sealed, role) {
        assert!(!matches!(error, WireError::Checksum { .. }), "{error}");
    }
}

fn decode<const N: usize>(bytes: &[u8], role: Role) -> Result<(), WireError> {
    match Frame::<N>::decode(bytes, role) {
        Ok(frame) => {
            for values in [frame.position, frame.velocity, frame.force] {
                assert!(values.iter().all(|value| value.is_finite() && value.abs() <= 1e4), "{frame:?}");
            }
            assert!(frame.gripper.is_none_or(|gripper| gripper.is_possible()), "{frame:?}");
            assert_eq!(frame.gripper.is_some(), bytes.len() == Frame::<N>::LENGTH_WITH_GRIPPER);
            let mut heard = HeardText::default();
            heard.take(&frame.text);
            assert!(heard.text().as_str().chars().all(|letter| !letter.is_control()), "{frame:?}");
            let mut buffer = [0; MAX_FRAME];
            assert_eq!(frame.encode(&mut buffer), bytes, "{frame:?}");
            Ok(())
        }
        Err(error) => {
            let said = error.to_string();
            assert!(!said.is_empty() && said.len() < 200 && !said.contains('\n'), "{said}");
            Err(error)
        }
    }
}
