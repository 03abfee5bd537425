//! Fuzz target: a scene as Python hands it over.

use std::sync::atomic::AtomicBool;

use haptether_bridge::scene::{SceneSpec, scene_axes, simulate};
use serde::Deserialize;

/// Panics unless `bytes` are refused with a word where and why, or are a scene that can be built or refused.
pub(crate) fn check(bytes: &[u8]) {
    match scene_axes(bytes) {
        Ok(1) => check_axes::<1>(bytes),
        Ok(2) => check_axes::<2>(bytes),
        Ok(3) => check_axes::<3>(bytes),
        Ok(4) => check_axes::<4>(bytes),
        Ok(5) => check_axes::<5>(bytes),
        Ok(6) => check_axes::<6>(bytes),
        Ok(7) => check_axes::<7>(bytes),
        Ok(axes) => {
            let said = simulate(bytes, &AtomicBool::new(true)).unwrap_err().to_string();
            assert_eq!(said, format!("master.axes = {axes}: must be 1 to 7"));
        }
        Err(error) => assert_says_where(&error),
    }
}

fn check_axes<const N: usize>(bytes: &[u8]) {
    let read = serde_json::from_slice::<SceneSpec<N>>(bytes);
    match &read {
        Ok(scene) => {
            // By way of a tree of values, as a sweep reads it.
            let tree: serde_json::Value = serde_json::from_slice(bytes).unwrap();
            assert_eq!(SceneSpec::deserialize(&tree).unwrap(), *scene);
            build(bytes);
        }
        Err(error) => assert_says_where(error),
    }
}

fn assert_says_where(error: &serde_json::Error) {
    let said = error.to_string();
    assert!(said.contains("line ") && said.contains("column "), "{said}");
}

/// Stopped before it begins: a scene is built and not run. By its bytes, so that the engine is not compiled again here
/// for each number of axes.
fn build(bytes: &[u8]) {
    if let Err(error) = simulate(bytes, &AtomicBool::new(true)) {
        let said = error.to_string();
        assert!(!said.is_empty() && !said.contains('\n'), "{said}");
    }
}
