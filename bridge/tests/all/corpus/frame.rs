//! Fuzz target: the decoder of frames.

use haptether_bridge::{
    CouplingMessage, ReceivedText, SideKind,
    coupling::{CouplingKind, canonical, is_canonical},
    wire::{Frame, FrameLayout, MAX_FRAME, Role, WireError},
};

/// Bytes of the checksum at the end.
const CHECKSUM: usize = 4;

/// Panics unless `bytes` are refused with a word why, or are the very bytes of the frame that they decode to.
///
/// In every layout; as they are, and under a checksum that is right: a fuzzer does not guess one.
pub(crate) fn check(bytes: &[u8]) {
    for role in [Role::Master, Role::Slave] {
        for kind in [SideKind::Linear, SideKind::Joints, SideKind::Pose] {
            for parts in 0..4 {
                let (has_gripper, has_buttons) = (parts & 1 != 0, parts & 2 != 0);
                for axes in 1..=7 {
                    for &coupling in CouplingKind::ALL {
                        let layout = FrameLayout { axes, kind, has_gripper, has_buttons, coupling };
                        check_layout(bytes, role, layout);
                    }
                }
            }
        }
    }
}

fn check_layout(bytes: &[u8], role: Role, layout: FrameLayout) {
    if !layout.kind.has_axes(layout.axes) {
        return;
    }
    if layout.length() != bytes.len() {
        let refused = Frame::decode(bytes, role, layout);
        assert_eq!(refused, Err(WireError::Length { seen: bytes.len(), allowed: layout.length() }));
        return;
    }
    let _ = decode(bytes, role, layout);
    let mut sealed = bytes.to_vec();
    let end = sealed.len() - CHECKSUM;
    let checksum = crc32fast::hash(&sealed[..end]);
    sealed[end..].copy_from_slice(&checksum.to_le_bytes());
    if let Err(error) = decode(&sealed, role, layout) {
        assert!(!matches!(error, WireError::Checksum { .. }), "{error}");
    }
}

fn decode(bytes: &[u8], role: Role, layout: FrameLayout) -> Result<(), WireError> {
    match Frame::decode(bytes, role, layout) {
        Ok(frame) => {
            let message = frame.message;
            for values in [frame.position, frame.velocity, frame.force, message.vector] {
                assert!(values.iter().all(|value| value.is_finite() && value.abs() <= 1e4), "{frame:?}");
            }
            assert_eq!(frame.layout(), layout);
            let is_coupled = message.epoch != 0 && layout.coupling != CouplingKind::PositionForce;
            assert!(
                is_coupled || CouplingMessage { epoch: 0, ..message } == CouplingMessage::default(),
                "{frame:?}"
            );
            assert_eq!(frame.rotation.is_some(), layout.kind == SideKind::Pose);
            if let Some(rotation) = frame.rotation {
                let quaternion = rotation.orientation.quaternion();
                assert!((quaternion.norm() - 1.0).abs() <= 1e-9, "{frame:?}");
                assert!(is_canonical(canonical(&rotation.orientation)), "{frame:?}");
                for values in [rotation.angular_velocity, rotation.torque] {
                    assert!(values.iter().all(|value| value.is_finite() && value.abs() <= 1e4), "{frame:?}");
                }
            }
            assert!(frame.gripper.is_none_or(|gripper| gripper.is_possible()), "{frame:?}");
            let mut heard = ReceivedText::default();
            heard.take(&frame.text);
            assert!(heard.text().as_str().chars().all(|letter| !letter.is_control()), "{frame:?}");
            let mut buffer = [0; MAX_FRAME];
            assert_eq!(frame.encode(&mut buffer), bytes, "{frame:?}");
            Ok(())
        }
        Err(error) => {
            let said = error.to_string();
            assert!(!said.is_empty() && said.len() < 300 && !said.contains('\n'), "{said}");
            Err(error)
        }
    }
}
